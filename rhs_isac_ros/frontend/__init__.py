"""The front end: a surface and a radio, each emulated or a driver of hardware.

A `Surface` shows configurations, and a `Radio` measures them. The built-in ones are listed in
`SURFACES` and `RADIOS` below, and other packages may provide more as entry points of
`plugins.SURFACES` and `plugins.RADIOS`. `make_surface` and `make_radio` create one by its name.

The modules, in reading order:

* `surface`: the interface, its faults, and the surface without hardware
* `opensourceris`: the board Open Source RIS on a serial port
* `opensourceris_emulator`: this board on a pseudo-terminal
* `waveform`: pilots as samples, synchronisation, and the sub-bands of a capture
* `radio`: the interface, and the emulated radios
* `sigmf_recording`: recordings of samples, and their playback
* `front_end`: a surface and a radio that are stepped together
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from rhs_isac_ros.frontend.front_end import FrontEnd
from rhs_isac_ros.frontend.opensourceris import OpenSourceRis
from rhs_isac_ros.frontend.radio import (
    Air,
    EmulatedRadio,
    Radio,
    RadioFault,
    Sounding,
    WaveformRadio,
)
from rhs_isac_ros.frontend.sigmf_recording import PlaybackRadio, SampleRecorder
from rhs_isac_ros.frontend.surface import EmulatedSurface, Surface, SurfaceFault
from rhs_isac_ros.frontend.waveform import Waveform
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.support import plugins

SURFACES: Mapping[str, Callable[..., Surface]] = {
    'emulated': EmulatedSurface, 'opensourceris': OpenSourceRis}
RADIOS: Mapping[str, Callable[..., Radio]] = {
    'emulated': EmulatedRadio, 'waveform': WaveformRadio, 'sigmf': PlaybackRadio}

__all__ = [
    'RADIOS', 'SURFACES', 'Air', 'EmulatedRadio', 'EmulatedSurface', 'FrontEnd', 'OpenSourceRis',
    'PlaybackRadio', 'Radio', 'RadioFault', 'SampleRecorder', 'Sounding', 'Surface',
    'SurfaceFault', 'Waveform', 'WaveformRadio', 'make_radio', 'make_surface']


def make_surface(name: str, n_elements: int, **options: Any) -> Surface:
    """Create a surface with a number of elements by its name.

    `opensourceris` requires ``port``, and has the further options of `OpenSourceRis`. Plug-ins
    define their own options.

    Raises ValueError if there is no surface of that name, or if it has another number of elements
    or no such option; and PluginError if a plug-in cannot be loaded, fails, or does not return a
    surface. No hardware is used before the first `apply`.
    """
    surface: Surface = _make(Surface, SURFACES, plugins.SURFACES, name, n_elements, **options)
    if surface.n_elements != n_elements:
        raise ValueError(f'{name}: {surface.n_elements} elements, expected {n_elements}')
    return surface


def make_radio(name: str, scenario: Scenario, air: Air, **options: Any) -> Radio:
    """Create a radio by its name; drivers of hardware ignore the emulated air.

    `sigmf` requires ``path``; see `PlaybackRadio`. The other radios and plug-ins define their own
    options.

    Raises ValueError if there is no radio of that name or no such option, or if it cannot measure
    the scenario; and PluginError if a plug-in cannot be loaded, fails, or does not return a radio.
    No hardware is used before the first `capture`.
    """
    return _make(Radio, RADIOS, plugins.RADIOS, name, scenario, air, **options)


def _make(kind: type, built_in: Mapping[str, Callable[..., Any]], group: str, name: str,
          *arguments: Any, **options: Any) -> Any:
    if name in built_in:
        try:
            inspect.signature(built_in[name]).bind(*arguments, **options)
        except TypeError as error:
            raise ValueError(f'{name}: {error}') from None
        return built_in[name](*arguments, **options)
    installed = plugins.names(group)
    if name not in installed and not plugins.is_reference(name):
        raise ValueError(f'{name!r}, expected one of {sorted({*built_in, *installed})}')
    return plugins.make(group, name, kind, *arguments, **options)
