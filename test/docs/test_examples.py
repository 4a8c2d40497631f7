"""The examples of the documentation run as described."""

import dataclasses
import re
import runpy
import shutil
import socket
import subprocess
import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest
from impairment_checks import CHECKS

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.frontend import Air, SurfaceFault, make_radio, make_surface
from rhs_isac_ros.model import Scenario, mobility, simulate_received
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.positioning import make_estimator
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
    (tmp_path / 'system.yaml').write_text('scenario: my.yaml\ncodebook: codebook.yaml\n')
    script = EXAMPLES / 'compare_estimators.py'
    monkeypatch.setattr(sys, 'argv', [str(script), str(tmp_path / 'system.yaml'), 'ml'])
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


def test_estimators_and_bounds_take_the_impairment_into_account():
    silent = Scenario(n_subbands=4, elements_per_side=5, roi_center_m=(2, 0, 0),
                      roi_size_m=(1, 1, 1))
    noisy = dataclasses.replace(silent, impairments={'phase_noise': 0.1})
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


def test_the_box_hall_is_that_of_the_package():
    example = runpy.run_path(str(EXAMPLES / 'box_hall.py'))
    traced = example['trace'](example['raster'](Scenario()))
    shipped = Scenario.from_yaml(EXAMPLES.parents[1] / 'config' / 'hall.yaml').channel
    np.testing.assert_array_equal(traced.users, shipped.users)
    np.testing.assert_allclose(traced.coefficients, shipped.coefficients, rtol=1e-5)
    # Two reflections at most, and nothing from behind the surface.
    assert set(traced.n[traced.a != 0]) == {0, 1, 2}
    assert (traced.src[traced.a != 0][:, 0] > 0).all()


def test_two_surfaces_locate_better_than_one(monkeypatch, capsys):
    site_file = EXAMPLES.parents[1] / 'config' / 'site.yaml'
    monkeypatch.setattr(sys, 'argv', ['two_surfaces.py', str(site_file)])
    runpy.run_path(str(EXAMPLES / 'two_surfaces.py'))
    printed = capsys.readouterr().out
    errors = np.array(re.findall(r'error (\S+) m with one surface, (\S+) m', printed), float)
    assert len(errors) == 5
    one, both = np.mean(errors**2, axis=0)
    assert both < one / 2


@pytest.fixture
def server():
    """A server as that of the board: it drops what does not come as one message of 1025 bytes."""
    listener = socket.create_server(('127.0.0.1', 0))
    state = types.SimpleNamespace(
        port=listener.getsockname()[1], shown=None, answers=iter(()), connections=0)

    def serve():
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            state.connections += 1
            with connection:
                while message := connection.recv(1025):
                    answer = next(state.answers, b'a')
                    if len(message) != 1025 or answer == b'':
                        continue
                    if answer == b'a':
                        state.shown = message
                    connection.sendall(answer)
                    if answer == b'b':
                        break
    thread = threading.Thread(target=serve)
    thread.start()
    yield state
    # A connection ends the wait of the thread.
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join()


@pytest.fixture
def openris(server):
    surface = make_surface(
        'openris', 512, address='127.0.0.1', port=server.port, tile=3, timeout_s=60.0)
    yield surface
    surface.close()


def test_the_board_over_tcp_shows_rows_from_the_top(openris, server):
    for element in (0, 511):
        openris.apply(np.eye(512)[element])
        bits = server.shown[2:].replace(b';', b' ').split()
        assert (server.shown[:2], len(bits)) == (b'03', 512)
        row, column = divmod(bits.index(b'1'), 16)
        assert (31 - row, column) == divmod(element, 16)
    assert server.connections == 1


@pytest.mark.parametrize(('answer', 'kind'), [
    (b'', 'silence'), (b'b', 'garbled'), (b'x', 'garbled'), (b'aa', 'garbled')])
def test_the_board_over_tcp_recovers_with_a_new_connection(
        openris, server, monkeypatch, answer, kind):
    server.answers = iter([answer])
    with monkeypatch.context() as patch, pytest.raises(SurfaceFault) as caught:
        if kind == 'silence':
            patch.setattr(openris, '_timeout_s', 0.1)
        openris.apply(np.ones(512))
    assert caught.value.kind == kind
    openris.apply(np.ones(512))
    assert server.connections == 2


def test_a_missing_server_is_a_fault(openris, server):
    missing = make_surface('openris', 512, address='127.0.0.1', port=1)
    with pytest.raises(SurfaceFault) as caught:
        missing.apply(np.ones(512))
    assert caught.value.kind == 'closed'
    with pytest.raises(plugins.PluginError, match='n_elements: 256, expected 512'):
        make_surface('openris', 256)


class Transceiver:
    """A transceiver that receives its own signal with a delay, after stale buffers."""

    FEEDS = np.array([[0.5j], [-0.25]])

    def __init__(self, uri):
        self.uri, self.rx_lo, self.tx_lo, self.n_stale = uri, 0, 0, 5

    def __setattr__(self, name, value):
        if name == 'rx_lo':
            self.n_stale = 5
        super().__setattr__(name, value)

    def tx(self, samples):
        self.sent = samples

    def rx(self):
        self.n_stale -= 1
        repeated = np.resize(self.sent, self.rx_buffer_size)
        return list(self.FEEDS * np.roll(repeated, 21) * (self.n_stale < 0))

    def tx_destroy_buffer(self):
        pass

    rx_destroy_buffer = tx_destroy_buffer


def test_the_transceiver_measures_both_bands_with_one_timing(monkeypatch):
    monkeypatch.setitem(sys.modules, 'adi', types.SimpleNamespace(ad9361=Transceiver))
    scenario = Scenario(n_feeds=2, n_frames=2, frame_duration_s=0.01, timing_std_s=1e-7,
                        band_phase_std_rad=6.2832)
    radio = make_radio('adi', scenario, Air(scenario, np.random.default_rng(0)), scale=1e-4)
    symbols, found = np.array([1.0, 1j]), []
    for band in range(2):
        captures = [radio.capture(band, radio.modem.pilot(symbol)) for symbol in symbols]
        found.append(radio.modem.receive(1, np.stack(captures), symbols, band, np.zeros(2)))
        assert radio._device.rx_lo == radio._device.tx_lo == scenario.center_frequencies_hz[band]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
    # The feeds differ as the receivers do; the delay is removed, up to a common phase.
    np.testing.assert_allclose(found[0][..., 0] / found[0][..., 1], -2j, rtol=1e-9)
    np.testing.assert_allclose(found[0], np.broadcast_to(found[0][:1, :1], found[0].shape),
                               rtol=1e-6)
    radio.close()
    assert radio._device is None
