"""The examples of the documentation run as described."""

import dataclasses
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from impairment_checks import CHECKS

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.calibration import Pilots, calibrate
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.experiments.sweep_settings import parse_axis, settings_of
from rhs_isac_ros.model import Scenario, draw_surface, mobility, simulate_received
from rhs_isac_ros.model.impairments import draw_factors
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.positioning import Tracker, make_estimator
from rhs_isac_ros.support import plugins

EXAMPLES = Path(__file__).parents[2] / 'docs' / 'examples'


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Folder into which pip has installed the example package."""
    folder = tmp_path_factory.mktemp('site')
    source = folder / 'source'
    # A copy, since pip builds inside the source folder.
    shutil.copytree(EXAMPLES / 'lab_plugins', source, ignore=shutil.ignore_patterns(
        'build', '*.egg-info', '__pycache__'))
    done = subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--no-build-isolation',
         '--no-index', '--disable-pip-version-check', '--target', folder / 'site', source],
        capture_output=True, text=True, timeout=240, check=False)
    if 'No module named pip' in done.stderr:
        pytest.skip('pip is not installed')
    assert done.returncode == 0, done.stderr
    return folder / 'site'


@pytest.fixture(autouse=True)
def installed(site, monkeypatch):
    monkeypatch.syspath_prepend(site)
    for name in [name for name in sys.modules if name.startswith('lab_plugins')]:
        monkeypatch.delitem(sys.modules, name)


def test_the_plugins_are_found():
    assert 'grid' in plugins.names(plugins.ESTIMATORS)
    assert 'circle' in plugins.names(plugins.MOBILITIES)
    assert 'patch' in plugins.names(plugins.GAIN_PATTERNS)
    assert 'phase_noise' in plugins.names(plugins.IMPAIRMENTS)


def test_the_estimator_locates_users():
    scenario = Scenario(n_subbands=4, elements_per_side=5, roi_center_m=(2, 0, 0),
                        roi_size_m=(1, 1, 1))
    rng = np.random.default_rng(1)
    codebook = random_codebook(scenario, rng)
    positions = scenario.sample_positions(50, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    errors = {}
    for name in ('grid', 'bayes'):
        estimator = make_estimator(name, scenario, codebook)
        assert estimator.name == name
        estimate = estimator.estimate(received)
        assert estimate.mean.shape == (50, 3)
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0
        errors[name] = np.mean(np.sum((estimate.mean - positions)**2, axis=1))
        np.testing.assert_allclose(
            estimator.estimate(received[0]).mean, estimate.mean[0], atol=1e-3)
    # The centre of the region has a mean squared error of 0.25 m^2.
    assert errors['grid'] < 0.1
    assert errors['grid'] < 2 * errors['bayes']


def test_the_mobility_moves_on_the_circle_at_its_speed():
    scenario = Scenario()
    for start in (None, (10.0, 1.0, 0.0)):
        user = mobility.make_plugin('circle', scenario, 1.5, np.random.default_rng(0), start)
        begin, velocity = user.state(100.0)
        if start:
            np.testing.assert_allclose(begin, [10.0, 2.0, 0.0], atol=1e-12)
        assert np.linalg.norm(begin - scenario.roi_center_m) == pytest.approx(2.0)
        assert np.linalg.norm(velocity) == pytest.approx(1.5)
        soon, _ = user.state(100.0 + 1e-5)
        np.testing.assert_allclose((soon - begin) / 1e-5, velocity, atol=1e-4)
        np.testing.assert_allclose(user.state(100.0 + 4 * np.pi / 1.5)[0], begin, atol=1e-9)


def test_the_gain_pattern_is_a_patch(tmp_path, small):
    (tmp_path / 'my.yaml').write_text('element_gain: patch\nuser_gain: 1.0\n')
    scenario = dataclasses.replace(
        small.scenario, element_gain=Scenario.from_yaml(tmp_path / 'my.yaml').element_gain)
    ahead, aside = np.array([[8.0, 0, 0]]), 8 * np.array([[0.5, np.sqrt(0.75), 0]])
    for place, gain in ((ahead, 2.0), (aside, 1.0)):
        shape = los_and_derivative(scenario, place, 0)[0] / los_and_derivative(
            small.scenario, place, 0)[0]
        np.testing.assert_allclose(shape, gain, rtol=0.03)
    # The slope of the example equals the numerical derivative.
    bare = dataclasses.replace(scenario, element_gain=scenario.element_gain.amplitude)
    np.testing.assert_allclose(crlb(bare, small.codebook, aside),
                               crlb(scenario, small.codebook, aside), rtol=1e-8)


@pytest.mark.parametrize('check', CHECKS, ids=lambda check: check.__name__)
def test_the_impairment_is_one(check):
    check({'impairments': {'phase_noise': 0.05}})


def test_the_scenario_of_the_tutorial_is_valid():
    scenario = Scenario.from_yaml(EXAMPLES / 'office.yaml')
    assert scenario.n_elements == 64
    assert scenario.center_frequencies_hz == (5.2e9, 5.8e9)


def test_estimators_are_compared(tmp_path, monkeypatch, capsys):
    (tmp_path / 'my.yaml').write_text(
        'n_subbands: 2\nn_frames: 2\nelements_per_side: 4\n'
        'roi_center_m: [2.0, 0.0, 0.0]\nroi_size_m: [1.0, 1.0, 1.0]\n')
    scenario = Scenario.from_yaml(tmp_path / 'my.yaml')
    random_codebook(scenario, np.random.default_rng(0)).save(tmp_path / 'codebook.yaml')
    script = EXAMPLES / 'compare_estimators.py'
    monkeypatch.setattr(sys, 'argv', [
        str(script), str(tmp_path / 'my.yaml'), str(tmp_path / 'codebook.yaml'), 'ml'])
    # Fifty positions suffice to run the script.
    exec(script.read_text(encoding='utf-8').replace('1000', '50'), {})
    name, error, unit = capsys.readouterr().out.split()
    assert (name, unit) == ('ml', 'm^2')
    assert 0 < float(error) < 0.5


def test_first_steps_locate_users(monkeypatch, capsys):
    monkeypatch.chdir(EXAMPLES.parents[1])
    end = runpy.run_path(str(EXAMPLES / 'first_steps.py'))
    assert np.linalg.norm(end['fix'].mean - end['positions'], axis=1).max() < 10
    assert len(capsys.readouterr().out.splitlines()) >= 4


def phase_noise_scenario(strength: float) -> Scenario:
    impairments = {'phase_noise': strength} if strength else {}
    return Scenario(n_subbands=4, elements_per_side=5, roi_center_m=(2, 0, 0),
                    roi_size_m=(1, 1, 1), impairments=impairments)


def test_estimators_tracks_and_bounds_take_the_impairment_into_account():
    silent, noisy = phase_noise_scenario(0.0), phase_noise_scenario(0.1)
    rng = np.random.default_rng(2)
    codebook = random_codebook(silent, rng)
    positions = noisy.sample_positions(40, rng)
    received = simulate_received(noisy, codebook, positions, rng)
    estimate = make_estimator('bayes', noisy, codebook).estimate(received)
    assert estimate.fix.all()
    errors = estimate.mean - positions
    squares = np.einsum('na,nab,nb->n', errors, np.linalg.inv(estimate.covariance), errors)
    assert np.mean(squares <= 7.815) > 0.85
    unaware = make_estimator('bayes', silent, codebook).estimate(received)
    assert not unaware.fix.all()
    assert (crlb(noisy, codebook, positions) > crlb(silent, codebook, positions)).all()
    tracker = Tracker(make_estimator('bayes', noisy, codebook))
    place = np.tile(positions[:1], (8, 1))
    for time_s, signals in enumerate(simulate_received(noisy, codebook, place, rng)):
        track = tracker.update(float(time_s), signals)
    assert np.linalg.norm(track.mean - place[0]) < 4 * np.sqrt(np.trace(track.covariance))


def test_calibration_takes_the_impairment_into_account():
    noisy, rng = phase_noise_scenario(0.1), np.random.default_rng(3)
    codebook = random_codebook(noisy, rng)
    surface = draw_surface(dataclasses.replace(noisy, element_error_rms=0.1), rng)
    positions = noisy.sample_positions(150, rng)
    received = simulate_received(noisy, codebook, positions, rng, surface)
    residual = {}
    for scenario in (noisy, phase_noise_scenario(0.0)):
        found = calibrate(scenario, [Pilots(codebook, positions, received)]).surface
        residual[scenario] = np.linalg.norm(found.gains - surface.gains)
    assert residual[noisy] < 0.7 * np.linalg.norm(surface.gains - 1)
    assert residual[noisy] < residual[phase_noise_scenario(0.0)]


def test_the_channel_draws_the_impairment_for_every_cycle():
    noisy = phase_noise_scenario(0.1)
    factors = [draw_factors(noisy, 1, np.random.default_rng(0), np.random.default_rng(cycle))
               for cycle in range(2)]
    assert not np.allclose(*factors)
    frames = np.angle(factors[0].reshape(noisy.n_bands, noisy.n_subbands, noisy.n_frames))
    # All sub-bands of a frame have the same phase, which differs from frame to frame.
    np.testing.assert_allclose(frames, np.broadcast_to(frames[:, :1], frames.shape))
    assert np.ptp(frames[:, 0], axis=1).min() > 0


def test_sweeps_vary_the_strength():
    axis = parse_axis('impairments={phase_noise: 0.02},{phase_noise: 0.2}')
    settings = settings_of(phase_noise_scenario(0.0), [axis], 'random', 'bayes')
    assert [one.scenario for one in settings] == [
        phase_noise_scenario(0.02), phase_noise_scenario(0.2)]


def test_the_box_hall_is_that_of_the_package():
    example = runpy.run_path(str(EXAMPLES / 'box_hall.py'))
    traced = example['trace'](example['raster'](Scenario()))
    shipped = Scenario.from_yaml(EXAMPLES.parents[1] / 'config' / 'hall.yaml').channel
    np.testing.assert_array_equal(traced.users, shipped.users)
    np.testing.assert_allclose(traced.coefficients, shipped.coefficients, rtol=1e-5)
    # Two reflections at most, and nothing from behind the surface.
    assert set(traced.n[traced.a != 0]) == {0, 1, 2}
    assert (traced.src[traced.a != 0][:, 0] > 0).all()
