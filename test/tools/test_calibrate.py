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
from std_srvs.srv import Trigger

from rhs_isac_ros.calibration import Calibration
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, draw_surface, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.settings import Impairments
from rhs_isac_ros.ros.recording import CycleObserver, Recorder
from rhs_isac_ros.support import streams
from rhs_isac_ros.tools import calibrate

pytest.importorskip('mcap', reason='mcap is not installed')
CONFIG = Path(__file__).parents[2] / 'config'
SCENARIO = Scenario.from_yaml(CONFIG / 'quick.yaml')
CODEBOOK = Codebook.load(CONFIG / 'codebook_quick.yaml')
NAMESPACE = '/damaged'
# Of this seed, four of 36 elements have failed, so that hardly any signals have a fix.
ERRORS = {'seed': 1, 'element_error_rms': 0.03, 'failed_element_share': 0.05}
N_PILOTS, N_FRESH = 45, 30
TIMEOUT_S = 60.0


@pytest.fixture(scope='module')
def process(module_processes):
    return module_processes.start(
        'network', namespace=NAMESPACE, users=4, mobility='random_walk', speed_mps=5.0,
        rest_s=0.03, scenario_file=CONFIG / 'quick.yaml',
        codebook_file=CONFIG / 'codebook_quick.yaml', **ERRORS)


@pytest.fixture(scope='module')
def watch(make_watch):
    return make_watch(NAMESPACE)


def request(watch, service):
    """Pause or resume the network, whose cycles would slow the calibrations down."""
    client = watch.node.create_client(Trigger, f'bs/{service}')
    assert watch.call(client, lambda client: client.call_async(Trigger.Request())).success


@pytest.fixture(scope='module')
def recording(process, watch, module_bench, tmp_path_factory):
    """A recording of the network before any calibration; the network is paused then."""
    path = tmp_path_factory.mktemp('recording') / 'run.mcap'
    watch.until(lambda: watch.received[m.NoFix], 'the first cycle', [process])
    recorder = Recorder(path, SCENARIO)
    observer = module_bench.add(CycleObserver, recorder, namespace=NAMESPACE)
    module_bench.until(lambda: sum(
        record.outcome == 'no_fix' for record in observer.log.ended) >= N_PILOTS, 'the pilots')
    module_bench.remove(observer)
    recorder.close()
    request(watch, 'pause')
    assert len(observer.log.complete) < N_PILOTS / 5
    return path


@pytest.fixture
def cycles(watch, recording):
    """The network runs during the test."""
    request(watch, 'resume')
    yield
    request(watch, 'pause')


@pytest.fixture
def two_folds(monkeypatch):
    """Two instead of five groups of places are left out: each is a survey, which takes long."""
    monkeypatch.setattr(calibrate, '_N_FOLDS', 2)


@pytest.fixture(scope='module')
def surface():
    declared = Impairments(**{name: value for name, value in ERRORS.items() if name != 'seed'})
    return draw_surface(declared.applied_to(SCENARIO),
                        streams.generator(ERRORS['seed'], streams.SURFACE))


def call(*arguments):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = calibrate.main([*map(str, arguments)])
    return types.SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())


@pytest.fixture(scope='module')
def calibrated(recording):
    """The file of the calibrated surface, and what the command printed."""
    file = recording.with_name('surface.npz')
    return file, call(recording, '--namespace', NAMESPACE, '--output', file)


def test_a_calibration_restores_the_accuracy_of_a_running_network(
        process, calibrated, surface, watch, cycles):
    """Errors come close to those of an estimator that knows the surface exactly."""
    file, done = calibrated
    assert (done.code, done.err) == (0, '')
    failed = np.nonzero(~np.isnan(surface.stuck))[0].tolist()
    assert [int(text) for text in re.findall(r'element (\d+) .*stuck at', done.out)] == failed
    before = re.search(r'pilots before: .*, (\d+) of (\d+) without a fix', done.out)
    assert int(before[1]) > 0.8 * int(before[2])
    assert re.search(r'pilots after: [\d.]+ m rms, 0 of \d+ without a fix', done.out)
    assert done.out.endswith(f'{file}: calibration {Calibration.load(file).id}\n')

    for node in ('positioner', 'transmission'):
        result = watch.set_parameters(node, {'calibration_file': file}, [process])
        assert result.successful, result.reason
    watch.until(lambda: process.log.count('bayes is ready') == 2, 'the estimator', [process])
    first = len(watch.received[m.PositionEstimate])
    watch.until(lambda: len(watch.received[m.PositionEstimate]) >= first + N_FRESH
                and len(watch.received[m.Capacity]) >= N_FRESH, 'estimates', [process])
    live, exact = compare(watch, watch.received[m.PositionEstimate][first:], surface)
    assert live.mean() < 1.5 * exact.mean()
    # Beams for the surface as it is lose little of the capacity.
    losses = [report.loss_percent for report in watch.received[m.Capacity]
              if np.isfinite(report.loss_percent)]
    assert np.median(losses) < 5


def compare(watch, estimates, surface):
    """Squared errors of the live estimates, and of those with the exact surface."""
    estimator = make_estimator('bayes', SCENARIO, CODEBOOK, surface=surface)
    live, exact = [], []
    for estimate in estimates:
        signals = watch.of_cycle(m.ReceivedSignals, estimate.cycle_id)
        truths = watch.of_cycle(m.GroundTruth, estimate.cycle_id)
        if signals and truths:
            place = truths[-1].position
            other = estimator.estimate(signals[-1].stacked)
            live.append(np.sum((estimate.position - place)**2))
            exact.append(np.sum((other.mean - place)**2))
    assert len(live) >= N_FRESH / 2
    return np.array(live), np.array(exact)


def test_the_pilots_may_come_from_the_running_network(built_scripts, cycles, tmp_path):
    done = subprocess.run(
        [CONFIG.parent / 'scripts' / 'calibrate', '--config', CONFIG / 'quick.yaml', '--cycles',
         '5', '--output', 'live.npz', '--ros-args', '-r', f'__ns:={NAMESPACE}'], cwd=tmp_path,
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stderr
    assert 5 <= Calibration.load(tmp_path / 'live.npz').about['pilots'] < 50


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


def test_arrays_are_a_survey_of_the_multipath(two_folds, tmp_path):
    rng = np.random.default_rng(0)
    positions = SCENARIO.sample_positions(12, rng)
    received = simulate_received(SCENARIO, CODEBOOK, positions, rng)
    np.savez(tmp_path / 'arrays.npz', positions=positions, received=received)
    options = ('--multipath', '--config', CONFIG / 'quick.yaml', '--codebook',
               CONFIG / 'codebook_quick.yaml', '--output', tmp_path / 'hall.npz')
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
    np.savez(tmp_path / 'arrays.npz', positions=positions)
    done = call(tmp_path / 'arrays.npz', *options)
    assert done.code == 2
    assert 'received: missing' in done.err


@pytest.mark.parametrize(('arguments', 'error'), [
    (['--namespace', '/lab'], 'no received signals with a true position'),
    (['--namespace', NAMESPACE, '--config', CONFIG / 'table1.yaml'], ': shape '),
    (['--states=1,-1'], 'run.mcap: expected no file with --states')])
def test_an_unusable_recording_is_named(recording, tmp_path, arguments, error):
    done = call(recording, '--output', tmp_path / 'x.npz', *arguments)
    assert done.code == 2
    assert done.err.startswith('calibrate: error: ')
    assert error in done.err
    assert len(done.err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_known_states_need_no_pilots(tmp_path):
    file = tmp_path / 'states.npz'
    done = call('--config', CONFIG / 'quick.yaml', '--states=0.5+0.5j,-1', '--output', file)
    calibration = Calibration.load(file)
    assert (done.code, done.out) == (0, f'{file}: calibration {calibration.id}\n')
    assert calibration.surface.applied(np.array([0.0] + [1.0] * 35)).tolist() == [
        0.5 + 0.5j, *[-1] * 35]


@pytest.mark.parametrize('states', ['1', '1,2,3', '1,x', 'nan,1', ''])
def test_states_are_two_numbers(states, capsys):
    with pytest.raises(SystemExit):
        calibrate.main([f'--states={states}'])
    assert f'--states: {states!r}, expected two numbers such as 1,-1' in capsys.readouterr().err
