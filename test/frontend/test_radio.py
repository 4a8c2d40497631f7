"""The contract of every radio, and their selection by name."""

import numpy as np
import pytest

from rhs_isac_ros.frontend import (
    RADIOS,
    Air,
    EmulatedSurface,
    FrontEnd,
    Radio,
    SampleRecorder,
    Sounding,
    make_radio,
)
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.plugins import PluginError

# A scenario that every radio can measure.
SCENARIO = Scenario(
    n_frames=3, frame_duration_s=0.01, n_feeds=2, band_phase_std_rad=6.2832, timing_std_s=1e-7)
PLUGIN = """
class Silent:
    waits, time_s = True, 0.0
    modem = object()
    def __init__(self, scenario, air, gain_db=0.0): pass
    def capture(self, band, pilot): pass
    def close(self): pass
def nothing(scenario, air): pass
"""


@pytest.fixture
def air():
    return Air(SCENARIO, np.random.default_rng(0))


@pytest.fixture(params=RADIOS)
def radio(request, air, tmp_path):
    options = {'path': recording(tmp_path)} if request.param == 'sigmf' else {}
    radio = make_radio(request.param, SCENARIO, air, **options)
    yield radio
    radio.close()


def recording(folder):
    """Record the signals of the tests below, as other radios receive them."""
    pytest.importorskip('sigmf', reason='sigmf is not installed')
    air = Air(SCENARIO, np.random.default_rng(2))
    radio = make_radio('waveform', SCENARIO, air)
    recorder = SampleRecorder(folder, SCENARIO, radio.modem, pytest.fail)
    FrontEnd(EmulatedSurface(SCENARIO.n_elements), radio, air, recorder).sound(
        np.zeros((3, SCENARIO.n_elements)), Sounding(
            1, 0, np.ones(3), flat(np.random.default_rng(1)), 1, np.ones(3), np.zeros(3)))
    recorder.close()
    return str(folder)


def measured(radio, air, signals, symbols, cycle_id=1, band=0):
    captures, times_s, air.cycle_id = [], [], cycle_id
    for air.frame, (air.signals, symbol) in enumerate(zip(signals, symbols, strict=True)):
        captures.append(radio.capture(band, radio.modem.pilot(symbol)))
        times_s.append(radio.time_s)
    return radio.modem.receive(cycle_id, np.stack(captures), symbols, band, np.array(times_s))


def flat(rng):
    """Return signals that are the same in all sub-bands, [F, N_SB, K]."""
    signals = rng.normal(size=(3, 1, 2, 2)) @ [1, 1j]
    return np.repeat(signals, SCENARIO.n_subbands, axis=1)


def test_signals_are_those_of_unit_symbols_up_to_one_phase(radio, air):
    assert isinstance(radio, Radio)
    rng = np.random.default_rng(1)
    signals, symbols = flat(rng), np.array([1j, -0.5, 2])
    found = measured(radio, air, signals, symbols)
    assert found.shape == signals.shape
    phase = np.exp(1j * np.angle(np.vdot(signals, found)))
    np.testing.assert_allclose(found, phase * signals, atol=0.01)


def test_a_closed_radio_opens_again(radio, air):
    signals = flat(np.random.default_rng(1))
    for cycle_id in (1, 2):
        radio.close()
        found = measured(radio, air, signals, np.ones(3), cycle_id)
        assert abs(np.vdot(signals, found)) == pytest.approx(
            np.linalg.norm(signals)**2, rel=0.01)


def test_a_plugin_is_a_radio(install, air):
    install('silent', PLUGIN, {plugins.RADIOS: {'silent': 'Silent', 'not': 'nothing'}})
    assert make_radio('silent', SCENARIO, air, gain_db=3.0).waits
    with pytest.raises(PluginError, match='returned None, expected an object with capture, '):
        make_radio('not', SCENARIO, air)
    with pytest.raises(ValueError, match=r"'x', expected one of \['emulated', .*'waveform'\]"):
        make_radio('x', SCENARIO, air)
