"""The optimiser as a command: its files, also after errors and interrupts."""

import dataclasses
import errno
import fnmatch
import functools
import os
import re

import numpy as np
import pytest
import yaml

from rhs_isac_ros.bounds import crlb, crlb_of
from rhs_isac_ros.calibration import Pilots, calibrate, prior_of
from rhs_isac_ros.codebook import Codebook, Provenance, __main__, band_plan, directional_codebook
from rhs_isac_ros.codebook.__main__ import main
from rhs_isac_ros.codebook.optimize import INTERRUPTED, _Report
from rhs_isac_ros.codebook.problem import Problem
from rhs_isac_ros.model import MeasurementModel, Scenario, draw_surface
from rhs_isac_ros.support import streams


@pytest.fixture
def files(scenario, tmp_path):
    """Folder with the file of the small scenario."""
    (tmp_path / 'scenario.yaml').write_text(
        yaml.safe_dump(scenario.changes()), encoding='utf-8')
    return tmp_path


@pytest.fixture
def call(files):
    """Callable that runs the command in that folder with few samples and returns its exit code."""
    def run(*arguments, output='codebook.yaml'):
        return main(['--scenario', str(files / 'scenario.yaml'), '--positions', '16', '--quiet',
                     '--output', str(files / output), *map(str, arguments)])
    return run


@pytest.fixture
def raising_after(monkeypatch):
    """Callable that sets the number of evaluations before an exception."""
    def arrange(n, error):
        evaluate, calls = Problem.value_and_gradient, []

        def spy(problem, variables):
            calls.append(None)
            if len(calls) > n:
                raise error
            return evaluate(problem, variables)
        monkeypatch.setattr(Problem, 'value_and_gradient', spy)
    return arrange


def test_the_summary_describes_the_codebook_written(call, files, scenario, capsys):
    assert call('--steps', 8, '--seed', 3) == 0
    codebook = Codebook.load(files / 'codebook.yaml')
    codebook.check(scenario)
    held_out = scenario.sample_positions(
        __main__.HELD_OUT_POSITIONS, streams.generator(3, streams.HELD_OUT))
    average = crlb(scenario, codebook, held_out).mean()
    assert codebook.average_crlb_m2 == pytest.approx(average, rel=1e-9)
    assert f'average CRLB {average:.5f} m^2 (standard error ' in capsys.readouterr().out
    made = Provenance.parse(codebook.provenance)
    assert (made.method, made.seed, made.positions, made.steps) == ('lbfgs', 3, 16, 8)
    assert made.scenario == scenario.changes()
    assert sorted(os.listdir(files)) == ['codebook.yaml', 'scenario.yaml']


def test_the_start_is_a_name_or_a_file(call, files, scenario):
    expected = directional_codebook(scenario)
    expected.save(files / 'start.yaml')
    for start in ('directional', files / 'start.yaml'):
        assert call('--method', 'random', '--start', start) == 0
        codebook = Codebook.load(files / 'codebook.yaml')
        np.testing.assert_array_equal(codebook.analog, expected.analog)


def test_a_start_with_continuous_amplitudes_suits_levels(call, files, scenario, small):
    small.codebook.save(files / 'start.yaml')
    levels = dataclasses.replace(scenario, amplitude_levels=2)
    (files / 'scenario.yaml').write_text(yaml.safe_dump(levels.changes()), encoding='utf-8')
    assert call('--steps', 1, '--start', files / 'start.yaml') == 0
    Codebook.load(files / 'codebook.yaml').check(levels)


def test_ctrl_c_writes_the_best_codebook_and_reports_it(
        call, files, raising_after, capsys):
    raising_after(6, KeyboardInterrupt)
    assert call('--steps', 30) == 0
    assert INTERRUPTED in capsys.readouterr().out
    made = Provenance.parse(Codebook.load(files / 'codebook.yaml').provenance)
    assert made.reason == INTERRUPTED
    assert 2 <= made.steps <= 6


def test_resume_continues_from_the_output(call, files):
    assert call('--steps', 5) == 0
    first = Provenance.parse(Codebook.load(files / 'codebook.yaml').provenance)
    assert call('--steps', 12, '--resume') == 0
    second = Provenance.parse(Codebook.load(files / 'codebook.yaml').provenance)
    assert (first.steps, second.steps) == (5, 12)
    assert second.evaluations > first.evaluations
    assert second.value_m2 < first.value_m2


@pytest.mark.slow
def test_resume_prefers_the_partial_file_of_an_unfinished_run(
        call, files, monkeypatch, raising_after):
    """A killed run leaves OUTPUT.part and does not change the last output."""
    assert call('--steps', 5) == 0
    good = (files / 'codebook.yaml').read_bytes()
    monkeypatch.setattr(_Report, '_KEEP_S', 0.0)

    class KilledError(BaseException):
        """An exception that no code handles."""

    raising_after(9, KilledError)
    with pytest.raises(KilledError):
        call('--steps', 20, '--seed', 1)
    monkeypatch.undo()
    assert (files / 'codebook.yaml').read_bytes() == good
    left = Provenance.parse(Codebook.load(files / 'codebook.yaml.part').provenance)
    assert left.seed == 1 and left.steps > 2
    assert call('--steps', 20, '--seed', 1, '--resume') == 0
    made = Provenance.parse(Codebook.load(files / 'codebook.yaml').provenance)
    assert (made.seed, made.steps) == (1, 20)
    assert not (files / 'codebook.yaml.part').exists()


def fails_with(call, capsys, words, *arguments, **options):
    try:
        code = call(*arguments, **options)
    except SystemExit as exit:
        code = exit.code
    assert code == 2
    captured = capsys.readouterr()
    assert 'error: ' in captured.err
    assert 'Traceback' not in captured.err
    for word in words:
        assert word in captured.err


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--positions', '0'], ['--positions: 0', 'expected 1 to']),
    (['--steps', '-1'], ['--steps: -1']),
    (['--start', '/no/file.yaml'], ['/no/file.yaml']),
    (['--resume', '--seed', '7'], ['seed: 7', 'as in the codebook to resume from'])])
def test_invalid_arguments_leave_the_last_output(call, files, capsys, arguments, words):
    assert call('--steps', 3) == 0
    good = (files / 'codebook.yaml').read_bytes()
    fails_with(call, capsys, words, *arguments)
    assert (files / 'codebook.yaml').read_bytes() == good


def test_the_bands_are_chosen_with_the_codebook(call, files, scenario, capsys, monkeypatch):
    short = band_plan.EFFORT._replace(short_steps=2, short_positions=4, short_shots=4, shots=4)
    for name in ('choose_bands', 'best_of'):
        monkeypatch.setattr(band_plan, name, functools.partial(
            getattr(band_plan, name), effort=short))
    plan, optimised = files / 'plan.yaml', band_plan.optimised
    arguments = ['--spectrum', '2.5e9:2.52e9', '3e9:3e9', '--bands', 2, '--raster', 5e6,
                 '--steps', 3, '--plan', plan, '--jobs', 1]

    # Jobs of another function, or of one with other values, are other jobs.
    def watched(**options):
        if options['max_steps'] == 3 and watched.is_interrupted:
            raise KeyboardInterrupt
        if options['max_steps'] != 3 and not watched.is_interrupted:
            pytest.fail('a finished job ran again')
        return optimised(**options)
    watched.is_interrupted = True
    monkeypatch.setattr(band_plan, 'optimised', watched)
    assert call(*arguments) == 130
    assert not (files / 'codebook.yaml').exists()
    watched.is_interrupted = False
    assert call(*arguments) == 0
    chosen, codebook = Scenario.from_yaml(plan), Codebook.load(files / 'codebook.yaml')
    assert (chosen.n_bands, chosen.n_frames) == (2, scenario.n_bands * scenario.n_frames // 2)
    allowed = [2.5e9, 2.505e9, 2.51e9, 2.515e9, 2.52e9, 3e9]
    assert np.isin(chosen.center_frequencies_hz, allowed).all()
    codebook.check(chosen)
    assert Provenance.parse(codebook.provenance).objective == 'error'
    assert f'{plan}: ' in capsys.readouterr().out
    assert not (files / 'codebook.yaml.jobs').exists()


def test_the_best_of_several_starts_is_written(call, files, scenario):
    values = {}
    for n in (1, 2, 8):
        assert call('--steps', 4, '--restarts', n, '--jobs', 1) == 0
        made = Provenance.parse(Codebook.load(files / 'codebook.yaml').provenance)
        values[n] = made.value_m2
        assert (made.seed, made.steps) == (0, 4)
    assert values[1] >= values[2] >= values[8] != values[1]


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--spectrum', '2.5e9:3e9'], ['--spectrum: expected together with --bands']),
    (['--bands', '2'], ['--bands: no effect, expected together with --spectrum']),
    (['--spectrum', '3e9:2e9', '--bands', '2'], ["--spectrum: '3e9:2e9', expected LOW:HIGH"]),
    (['--spectrum', '3e9', '--bands', '2'], ["--spectrum: '3e9', expected LOW:HIGH"]),
    (['--spectrum', '2e9:3e9', '--bands', '2', '--start', 'random'], ['not allowed with']),
    (['--spectrum', '2e9:3e9', '--bands', '2', '--calibration', __file__],
     ['--calibration: not allowed with --spectrum']),
    (['--restarts', '2', '--start', 'random'], ['--restarts: not allowed with']),
    (['--resume', '--dask', 'localhost:1'], ['--resume: ']),
    (['--spectrum', '2e9:3e9', '--bands', '3'], ['bands: 3, expected a divisor of 2'])])
def test_invalid_band_plans_are_errors(call, files, capsys, arguments, words):
    plan = ['--plan', files / 'plan.yaml'] if '--spectrum' in arguments else []
    fails_with(call, capsys, words, *plan, *arguments)
    assert not (files / 'plan.yaml').exists()


def test_an_output_that_cannot_be_written_is_reported_before_the_search(call, files, capsys):
    fails_with(call, capsys, ['none/codebook.yaml', 'can be written'],
               output='none/codebook.yaml')
    fails_with(call, capsys, ['none/p.png'], '--plot', files / 'none' / 'p.png')


@pytest.fixture
def full_disk(monkeypatch):
    """Function that makes every write fail whose path matches a pattern; files are kept often."""
    save = Codebook.save

    def arrange(pattern):
        def save_or_not(codebook, target):
            if fnmatch.fnmatch(str(target), pattern):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            save(codebook, target)
        monkeypatch.setattr(Codebook, 'save', save_or_not)
        monkeypatch.setattr(_Report, '_KEEP_S', 0.0)
    return arrange


def test_a_full_disk_loses_neither_the_last_output_nor_the_result(
        call, files, capsys, monkeypatch, full_disk, tmp_path_factory):
    assert call('--steps', 3) == 0
    good = (files / 'codebook.yaml').read_bytes()
    rescue = tmp_path_factory.mktemp('rescue')
    monkeypatch.setattr('tempfile.tempdir', str(rescue))
    full_disk(f'{files}/*')
    assert call('--steps', 4) == 1
    assert re.search(f'error: .*No space left.*{rescue}', capsys.readouterr().err)
    assert (files / 'codebook.yaml').read_bytes() == good
    (saved,) = rescue.glob('*/codebook.yaml')
    assert Provenance.parse(Codebook.load(saved).provenance).steps == 4


def test_a_partial_file_that_cannot_be_written_is_a_warning(call, files, capsys, full_disk):
    full_disk('*.part')
    assert call('--steps', 3) == 0
    assert 'warning: ' in capsys.readouterr().err
    assert Provenance.parse(Codebook.load(files / 'codebook.yaml').provenance).steps == 3


@pytest.fixture
def calibration(scenario, files, random_beams):
    """A calibration of a surface with errors, in a file."""
    rng = np.random.default_rng(0)
    declared = dataclasses.replace(
        scenario, element_error_rms=0.3, failed_element_share=0.2)
    beams, positions = random_beams(scenario, rng), scenario.sample_positions(40, rng)
    model = MeasurementModel(scenario, beams, draw_surface(declared, rng))
    calibration = calibrate(
        scenario, [Pilots(beams, positions, model.sample(positions, rng))], prior_of(declared))
    calibration.save(files / 'calibration.npz')
    return calibration


def test_a_codebook_is_optimised_for_a_calibrated_surface(
        call, files, scenario, calibration, capsys):
    assert call('--steps', 40, '--calibration', files / 'calibration.npz') == 0
    codebook = Codebook.load(files / 'codebook.yaml')
    assert Provenance.parse(codebook.provenance).calibration == calibration.id
    held_out = scenario.sample_positions(
        __main__.HELD_OUT_POSITIONS, streams.generator(0, streams.HELD_OUT))
    model = MeasurementModel(scenario, codebook, calibration.surface)
    assert codebook.average_crlb_m2 == pytest.approx(crlb_of(model, held_out).mean(), rel=1e-9)
    # A codebook for an ideal surface is worse on the calibrated one.
    assert call('--steps', 40) == 0
    ideal = Codebook.load(files / 'codebook.yaml')
    assert crlb_of(MeasurementModel(scenario, ideal, calibration.surface),
                   held_out).mean() > codebook.average_crlb_m2
    assert call('--calibration', files / 'calibration.npz', '--resume') == 2
    assert "calibration: 'ca" in capsys.readouterr().err


def test_a_calibration_of_another_scenario_is_refused(files, calibration, capsys):
    assert main(['--calibration', str(files / 'calibration.npz'), '--output',
                 str(files / 'codebook.yaml'), '--quiet']) == 2
    assert ' error: scenario_id: ' in capsys.readouterr().err
    assert not (files / 'codebook.yaml').exists()


def test_the_picture_shows_the_codebook_and_the_history(call, files, monkeypatch):
    pytest.importorskip('matplotlib')
    drawn = {}
    monkeypatch.setattr(__main__, 'plot_optimization', lambda _, *shown: shown)
    monkeypatch.setattr(__main__, 'write_picture', drawn.__setitem__)
    assert call('--steps', 3, '--plot', files / 'picture.png') == 0
    codebook, history = drawn[files / 'picture.png']
    assert codebook.id == Codebook.load(files / 'codebook.yaml').id
    assert len(history) == 4
