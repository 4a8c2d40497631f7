"""The command for pilots in arrays, and for known states: it needs no network and no ROS."""

import dataclasses
import re
import types
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.calibration import Calibration
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments import __main__
from rhs_isac_ros.model import Scenario, simulate_received

CONFIG = Path(__file__).parents[2] / 'config'
SCENARIO = Scenario.from_yaml(CONFIG / 'quick.yaml')
CODEBOOK = Codebook.load(CONFIG / 'codebook_quick.yaml')


@pytest.fixture
def call(capsys):
    """Run the command; return its exit code, also of a usage error, and what it prints."""
    def run(*arguments):
        try:
            code = __main__.main(['calibrate', *map(str, arguments)])
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        # On a slow machine, the progress of the jobs appears.
        return types.SimpleNamespace(
            code=code, out=out, err=re.sub(r'job \d+ of \d+: .*\n', '', err))
    return run


def test_arrays_are_a_survey_of_the_multipath(two_folds, tmp_path, call):
    rng = np.random.default_rng(0)
    positions = SCENARIO.sample_positions(12, rng)
    received = simulate_received(SCENARIO, CODEBOOK, positions, rng)
    np.savez(tmp_path / 'arrays.npz', positions=positions, received=received)
    options = ('--multipath', '--config', CONFIG / 'quick.yaml', '--codebook',
               CONFIG / 'codebook_quick.yaml', '--jobs', '1', '--output', tmp_path / 'hall.npz')
    done = call(tmp_path / 'arrays.npz', *options)
    assert (done.code, done.err) == (0, '')
    assert 'warning: positions: 12, expected at least 20' in done.out
    assert re.search(r'left-out pilots after: [\d.]+ m rms, 0 of 12 without a fix', done.out)
    for values, error in (
            (positions.astype(str), 'of type <U32, expected numbers'),
            (1000 * positions, 'expected at most its longest side, 10 m, in metres')):
        np.savez(tmp_path / 'arrays.npz', positions=values, received=received)
        done = call(tmp_path / 'arrays.npz', *options)
        assert done.code == 2 and error in done.err
        assert len(done.err.splitlines()) == 1
        assert not (tmp_path / 'hall.npz.jobs').exists()
    np.savez(tmp_path / 'arrays.npz', positions=positions)
    done = call(tmp_path / 'arrays.npz', *options)
    assert done.code == 2
    assert 'received: missing' in done.err


def test_a_calibration_that_makes_errors_larger_is_called_so(two_folds, tmp_path, call):
    rng = np.random.default_rng(0)
    positions = SCENARIO.sample_positions(20, rng)
    received = simulate_received(SCENARIO, CODEBOOK, positions, rng)
    # Positions that are known to 10 cm do not suffice.
    np.savez(tmp_path / 'arrays.npz', received=received,
             positions=positions + 0.1 * rng.standard_normal(positions.shape))
    done = call(tmp_path / 'arrays.npz', '--config', CONFIG / 'quick.yaml', '--codebook',
                CONFIG / 'codebook_quick.yaml', '--jobs', '1', '--output',
                tmp_path / 'surface.npz')
    assert done.code == 0
    assert done.out.splitlines()[-2] == (
        'warning: significantly more left-out pilots are located worse after it than better')


def test_boards_are_compared_and_the_best_one_is_fitted(tmp_path, call):
    rng = np.random.default_rng(0)
    lossy = dataclasses.replace(SCENARIO, board={'kind': 'paper', 'loss_db_per_m': 20.0})
    positions = SCENARIO.sample_positions(40, rng)
    np.savez(tmp_path / 'arrays.npz', positions=positions,
             received=simulate_received(lossy, CODEBOOK, positions, rng))
    options = (tmp_path / 'arrays.npz', '--config', CONFIG / 'quick.yaml', '--codebook',
               CONFIG / 'codebook_quick.yaml', '--jobs', '1', '--output', tmp_path / 'x.npz',
               '--board')
    done = call(*options, 'resonant', '{kind: paper, loss_db_per_m: 9}', '--fit', 'loss_db_per_m')
    assert (done.code, done.err) == (0, '')
    lines = done.out.splitlines()
    assert lines[0] == '{kind: paper, loss_db_per_m: 9.0}: log evidence 0.0'
    assert lines[1].startswith('paper: log evidence -')
    assert lines[2].startswith('resonant: log evidence -')
    value, std = map(float, re.match(
        r'loss_db_per_m: ([\d.]+) \+- ([\d.]+); row of the covariance: ', lines[3]).groups())
    assert abs(value - 20) < 3 * std < 15
    board = re.fullmatch(r'log evidence [\d.]+ with the line "board: (.*)" in the scenario file',
                         lines[4])[1]
    assert float(re.search('loss_db_per_m: ([^}]+)}', board)[1]) == pytest.approx(value)
    assert not (tmp_path / 'x.npz.jobs').exists()
    done = call(*options, '--fit', 'masked')
    assert (done.code, done.out) == (2, 'paper: log evidence 0.0\n')
    assert "masked: expected a field of the board 'paper'" in done.err
    assert len(done.err.splitlines()) == 1
    for wrong, error in (((*options, 'none'), "argument --board: 'none', expected a plug-in"),
                         ((*options[:-1], '--fit', 'masked'), 'together with --board')):
        assert error in call(*wrong).err


def test_known_states_need_no_pilots(tmp_path, call):
    file = tmp_path / 'states.npz'
    done = call('--config', CONFIG / 'quick.yaml', '--states=0.5+0.5j,-1', '--output', file)
    calibration = Calibration.load(file)
    assert (done.code, done.out) == (0, f'{file}: calibration {calibration.id}\n')
    assert calibration.surface.applied(np.array([0.0] + [1.0] * 35)).tolist() == [
        0.5 + 0.5j, *[-1] * 35]


def test_a_full_disk_keeps_an_existing_file(tmp_path, monkeypatch, call, full_disk):
    file = tmp_path / 'states.npz'
    file.write_text('old', encoding='utf-8')
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    with full_disk(10):
        done = call('--states=1,-1', '--output', file)
    assert (done.code, done.out) == (1, '')
    assert done.err.endswith(f"calibrate: error: [Errno 27] File too large: '{file}'\n")
    assert [(path, path.read_text(encoding='utf-8')) for path in tmp_path.iterdir()] == [
        (file, 'old')]


@pytest.mark.parametrize('states', ['1', '1,2,3', '1,x', 'nan,1', ''])
def test_states_are_two_numbers(states, call):
    assert f'--states: {states!r}, expected two numbers such as 1,-1' in call(
        f'--states={states}').err
