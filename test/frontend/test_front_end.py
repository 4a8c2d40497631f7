"""A surface and a radio that are stepped together."""

import types

import numpy as np
import pytest

from rhs_isac_ros.frontend import (
    Air,
    EmulatedRadio,
    EmulatedSurface,
    FrontEnd,
    RadioFault,
    Sounding,
    SurfaceFault,
)
from rhs_isac_ros.model import Scenario

SCENARIO = Scenario(n_subbands=2, n_frames=3, n_feeds=1, elements_per_side=2)
CONFIGURATIONS = np.eye(4)[:3]


class Recording:
    """A surface and a radio that record the order of their calls; `fails` is the failing one."""

    n_elements, waits, time_s, modem = 4, True, 0.0, types.SimpleNamespace(
        pilot=lambda symbol: symbol, receive=lambda cycle_id, captures, *others: captures)

    def __init__(self, fails=None, capture=((1.0,), (1.0,))):
        self.calls, self._fails, self._capture = [], fails, np.array(capture)

    def apply(self, configuration):
        self._call(f'show {np.argmax(configuration)}', SurfaceFault('silence', 'none'))

    def capture(self, band, pilot):
        self._call(f'capture {band} {pilot:g}', OSError('gone'))
        return self._capture

    def close(self):
        self._call('close', OSError('gone'))

    def _call(self, name, error):
        self.calls.append(name)
        if name == self._fails:
            raise error


def front_end(surface, radio):
    return FrontEnd(surface, radio, Air(SCENARIO, np.random.default_rng(0)))


def sound(parts):
    """Measure a band with a surface and radio."""
    return front_end(parts, parts).sound(
        CONFIGURATIONS, Sounding(1, 0, np.arange(3), np.ones((3, 2, 1)), 1, np.zeros(3),
                                 np.zeros(3)))


def test_each_frame_is_measured_while_its_configuration_is_shown():
    parts = Recording()
    assert sound(parts).shape == (3, 2, 1)
    # The last confirmation covers the last capture.
    assert parts.calls == ['show 0', 'capture 0 0', 'show 1', 'capture 0 1', 'show 2',
                           'capture 0 2', 'show 2']


@pytest.mark.parametrize(('fails', 'kind', 'n'), [
    ('show 1', SurfaceFault, 3), ('capture 0 1', RadioFault, 4), ('show 2', SurfaceFault, 5)])
def test_nothing_is_measured_after_a_fault(fails, kind, n):
    parts = Recording(fails)
    with pytest.raises(kind):
        sound(parts)
    assert len(parts.calls) == n


@pytest.mark.parametrize(('capture', 'name'), [
    (np.ones((1, 1)), 'signals'), (np.ones((0, 1)), 'signals'),
    (np.full((2, 1), np.nan), 'captures')])
def test_captures_of_another_size_are_a_fault_of_the_radio(capture, name):
    with pytest.raises(RadioFault, match=f'^{name}: .*, expected '):
        sound(Recording(capture=capture))


def test_both_parts_are_released_even_if_one_fails():
    surface, radio = Recording('close'), Recording()
    with pytest.raises(OSError, match='gone'):
        front_end(surface, radio).close()
    assert radio.calls == ['close']


def test_only_parts_of_hardware_need_a_thread():
    surface, radio = EmulatedSurface(4), EmulatedRadio(SCENARIO, None)
    assert not front_end(surface, radio).waits
    assert front_end(Recording(), radio).waits
    assert front_end(surface, Recording()).waits
