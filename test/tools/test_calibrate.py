"""``scripts/calibrate`` on a recording of a network with a damaged surface, and what follows."""

import contextlib
import dataclasses
import io
import re
import subprocess
import types
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.calibration import Calibration
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments import pilots
from rhs_isac_ros.link import choose_beam
from rhs_isac_ros.model import Scenario, draw_surface, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.settings import Impairments
from rhs_isac_ros.ros import convert
from rhs_isac_ros.ros.recording import Recorded
from rhs_isac_ros.support import streams
from rhs_isac_ros.tools import calibrate

pytest.importorskip('mcap', reason='mcap is not installed')
CONFIG = Path(__file__).parents[2] / 'config'
SCENARIO = Scenario.from_yaml(CONFIG / 'quick.yaml')
CODEBOOK = Codebook.load(CONFIG / 'codebook_quick.yaml')
NAMESPACE = '/damaged'
# Of this seed, four of 36 elements have failed, so that hardly any signals have a fix.
ERRORS = {'seed': 1, 'element_error_rms': 0.03, 'failed_element_share': 0.05}
N_PILOTS, N_SERVED = 40, 3
TIMEOUT_S = 120.0


@pytest.fixture(scope='module')
def process(module_processes):
    return module_processes.start(
        'network', namespace=NAMESPACE, users=4, rest_s=0.1, scenario_file=CONFIG / 'quick.yaml',
        codebook_file=CONFIG / 'codebook_quick.yaml', **ERRORS)


@pytest.fixture(scope='module')
def watch(make_watch):
    return make_watch(NAMESPACE)


@pytest.fixture(scope='module')
def record(write_recording, tmp_path_factory):
    """Function that records users at known positions, in given namespaces of messages."""
    def record(n, surface=None, *namespaces, name='run.mcap'):
        rng = np.random.default_rng(0)
        positions = SCENARIO.sample_positions(n, rng)
        received = simulate_received(SCENARIO, CODEBOOK, positions, rng, surface)
        sizes = SCENARIO.n_bands, SCENARIO.n_subbands, SCENARIO.n_frames
        about = {'scenario_id': SCENARIO.id, 'user': 1}
        return write_recording(
            tmp_path_factory.mktemp('recording') / name,
            [convert.CodebookMessage.of(CODEBOOK, scenario_id=SCENARIO.id), *(
                message for number, (position, signals) in enumerate(
                    zip(positions, received, strict=True), 1)
                for message in (
                    m.GroundTruth(
                        cycle_id=number, position=position, velocity=np.zeros(3), **about),
                    m.ReceivedSignals(cycle_id=number, codebook_id=CODEBOOK.id,
                                      signals=signals.reshape(sizes), **about)))], *namespaces)
    return record


@pytest.fixture(scope='module')
def recording(record, surface):
    """A recording before any calibration."""
    return record(N_PILOTS, surface, NAMESPACE)


@pytest.fixture(scope='module')
def surface():
    declared = Impairments(**{name: value for name, value in ERRORS.items() if name != 'seed'})
    return draw_surface(declared.applied_to(SCENARIO),
                        streams.generator(ERRORS['seed'], streams.SURFACE))


def call(*arguments):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = calibrate.main(['--jobs', '1', *map(str, arguments)])
    # On a slow machine, the progress of the jobs appears.
    err = re.sub(r'job \d+ of \d+: .*\n', '', err.getvalue())
    return types.SimpleNamespace(code=code, out=out.getvalue(), err=err)


@pytest.fixture(scope='module')
def calibrated(recording):
    """The file of the calibrated surface, and what the command printed."""
    file = recording.with_name('surface.npz')
    return file, call(recording, '--namespace', NAMESPACE, '--output', file)


def test_a_calibration_finds_failed_elements_and_restores_the_accuracy(calibrated, surface):
    file, done = calibrated
    assert (done.code, done.err) == (0, '')
    failed = np.nonzero(~np.isnan(surface.stuck))[0].tolist()
    assert [int(text) for text in re.findall(r'element (\d+) .*stuck at', done.out)] == failed
    before = re.search(r'pilots before: .*, (\d+) of (\d+) without a fix', done.out)
    assert int(before[1]) > 0.8 * int(before[2])
    assert re.search(r'pilots after: [\d.]+ m rms, 0 of \d+ without a fix', done.out)
    assert done.out.endswith(f'{file}: calibration {Calibration.load(file).id}\n')


def test_a_recording_is_a_survey_of_the_multipath(recording, calibrated, two_folds, tmp_path):
    hall = tmp_path / 'hall.npz'
    done = call(recording, '--namespace', NAMESPACE, '--output', hall, '--multipath',
                '--calibration', calibrated[0])
    assert (done.code, done.err) == (0, '')
    assert re.search(r'pilots after: [\d.]+ m rms, 0 of \d+ without a fix', done.out)
    estimate = dataclasses.replace(SCENARIO, multipath=hall).multipath
    # The emulated multipath is the declared one.
    assert estimate.multipath_to_los_db == pytest.approx(
        SCENARIO.multipath_to_los_db, abs=2)
    assert f'{estimate.about["positions"]} positions' in done.out
    assert done.out.splitlines()[-1].startswith(f'{hall}: multipath {estimate.digest}; ')


def test_pilots_of_a_site_have_the_true_positions_of_its_leading_surface(
        record, tmp_path, monkeypatch):
    """The other surfaces record none."""
    file = record(4, None, '/lab/side', {m.GroundTruth: '/lab/front'}, name='site.mcap')
    monkeypatch.setattr(calibrate, 'read_networks', lambda path: Recorded(
        None, dict.fromkeys(('front', 'side'), SCENARIO), SCENARIO.roi_bounds_m))
    done = call(file, '--namespace', '/lab/side', '--board', 'phase', '--output',
                tmp_path / 'x.npz')
    assert (done.code, done.err) == (0, '')
    assert done.out.startswith('paper: log evidence 0.0\nphase: log evidence -')


def test_an_interrupted_calibration_continues_in_other_processes(calibrated, recording, tmp_path,
                                                                 monkeypatch):
    pytest.importorskip('joblib')
    file, answered, calls = tmp_path / 'surface.npz', pilots.answered, []

    def interrupted(**options):
        calls.append(options)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return answered(**options)
    with monkeypatch.context() as patch:
        patch.setattr(pilots, 'answered', interrupted)
        call(recording, '--namespace', NAMESPACE, '--output', file)
    assert len([*(tmp_path / 'surface.npz.jobs').glob('*.json')]) == 3
    done = call(recording, '--namespace', NAMESPACE, '--output', file, '--jobs', '2')
    assert done.out.splitlines()[:-1] == calibrated[1].out.splitlines()[:-1]
    assert file.read_bytes() == calibrated[0].read_bytes()
    assert not (tmp_path / 'surface.npz.jobs').exists()


@pytest.mark.parametrize(('arguments', 'error'), [
    (['--namespace', '/lab'], f'in the namespace /lab; --namespace selects one of {NAMESPACE}'),
    (['--namespace', NAMESPACE, '--config', CONFIG / 'table1.yaml'], ': shape ')])
def test_an_unusable_recording_is_named(recording, tmp_path, arguments, error):
    done = call(recording, '--output', tmp_path / 'x.npz', *arguments)
    assert done.code == 2
    assert done.err.startswith('calibrate: error: ')
    assert error in done.err
    assert len(done.err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


# The network starts for these tests, and runs until the last one has ended.

def test_a_running_network_takes_a_calibration(process, calibrated, watch):
    """It then estimates and steers as the library does with the calibrated surface."""
    file, _ = calibrated
    watch.until(lambda: 'bayes is ready' in process.log, 'the first estimator', [process])
    for node in ('positioner', 'transmission'):
        result = watch.set_parameters(node, {'calibration_file': file}, [process])
        assert result.successful, result.reason
    watch.until(lambda: process.log.count('bayes is ready') == 2, 'the estimator', [process])
    # A cycle that had begun keeps the former surface.
    watch.until_served(1, processes=[process])
    calibrated_surface = Calibration.load(file).surface
    estimator = make_estimator('bayes', SCENARIO, CODEBOOK, surface=calibrated_surface)
    for end in watch.until_served(N_SERVED, processes=[process]):
        signals, estimate, beam = (watch.until(
            lambda kind=kind, n=end.cycle_id: watch.of_cycle(kind, n), kind.__name__)[0]
            for kind in (m.ReceivedSignals, m.PositionEstimate, m.Beam))
        expected = estimator.estimate(signals.stacked).to_site(SCENARIO.pose)
        assert estimate.position == pytest.approx(expected.mean, abs=1e-6)
        assert estimate.covariance_m2 == pytest.approx(expected.covariance, abs=1e-6)
        choice = choose_beam(SCENARIO, estimate.position, estimate.covariance_m2,
                             range(SCENARIO.n_bands), calibrated_surface)
        assert beam.band == choice.beam.band
        assert beam.analog == pytest.approx(choice.beam.analog, abs=1e-6)


def test_the_pilots_may_come_from_the_running_network(built_scripts, process, tmp_path):
    done = subprocess.run(
        [CONFIG.parent / 'scripts' / 'calibrate', '--config', CONFIG / 'quick.yaml', '--cycles',
         '5', '--jobs', '1', '--output', 'live.npz', '--ros-args', '-r', f'__ns:={NAMESPACE}'],
        cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stderr
    assert 5 <= Calibration.load(tmp_path / 'live.npz').about['pilots'] < 50
