"""A surface and a radio that one thread steps together.

No board has a trigger for the frames of a radio, so the thread that shows the configurations also
takes the samples.
"""

import contextlib
from collections.abc import Iterable, Mapping

import numpy as np

from rhs_isac_ros.frontend.radio import Air, Radio, RadioFault, Sounding
from rhs_isac_ros.frontend.sigmf_recording import SampleRecorder
from rhs_isac_ros.frontend.surface import Surface
from rhs_isac_ros.model.arrays import numbers
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.plugins import calling


class FrontEnd:
    """A surface and a radio; `air` is that of an emulated radio.

    With a `recorder`, the samples of all bands that were measured completely are recorded.
    """

    def __init__(self, surface: Surface, radio: Radio, air: Air,
                 recorder: SampleRecorder | None = None) -> None:
        self._surface, self._radio, self._air = surface, radio, air
        self._recorder = recorder

    @property
    def waits(self) -> bool:
        """Whether the methods wait for hardware or a disk, so that they need a thread."""
        return self._surface.waits or self._radio.waits or self._recorder is not None

    def show(self, configurations: Iterable[np.ndarray]) -> None:
        """Show configurations one after the other; exceptions are those of the surface."""
        for configuration in configurations:
            self._surface.apply(configuration)

    def sound(self, configurations: np.ndarray, sounding: Sounding) -> np.ndarray:
        """Show the configuration of each frame, [F, N_E], and measure it.

        Returns the signals at the feeds for unit symbols, complex128 [F, N_SB, K]. Raises
        RadioFault for an exception of the radio; others are those of the surface.
        """
        captures, times_s = [], []
        self._air.cycle_id = sounding.cycle_id
        for self._air.frame, (configuration, symbol, self._air.signals) in enumerate(zip(
                configurations, sounding.symbols, sounding.arriving, strict=True)):
            self._surface.apply(configuration)
            captures.append(self._capture(sounding.band, symbol))
            times_s.append(self._radio.time_s)
        # A fault during the last measurement would be noticed only with the next band.
        self._surface.apply(configurations[-1])
        feeds = self._receive(sounding, captures, np.array(times_s))
        if self._recorder:
            self._recorder.add(configurations, sounding, np.array(captures), times_s)
        return feeds

    def status(self) -> Mapping[str, str]:
        """Return details of the radio for the diagnostics."""
        with calling(f'{type(self._radio).__name__}.modem.status'):
            return self._radio.modem.status()

    def close(self) -> None:
        """Release the surface and the radio, and complete the recording."""
        with contextlib.ExitStack() as stack:
            if self._recorder:
                stack.callback(self._recorder.close)
            stack.callback(self._radio.close)
            self._surface.close()

    def _capture(self, band: int, symbol: complex) -> np.ndarray:
        # A driver may raise any exception.
        try:
            return self._radio.capture(band, self._radio.modem.pilot(symbol))
        except Exception as error:
            raise RadioFault(f'{type(error).__name__}: {error}') from error

    def _receive(self, sounding: Sounding, captures: list[np.ndarray], times_s: np.ndarray
                 ) -> np.ndarray:
        # The captures may have any size. A modem may skip samples that are no numbers.
        with translated(ValueError, RadioFault):
            return numbers('signals', self._radio.modem.receive(
                sounding.cycle_id, numbers('captures', np.array(captures), complex),
                sounding.symbols, sounding.band, times_s),
                complex, shapes=[sounding.arriving.shape])
