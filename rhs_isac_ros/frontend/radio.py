"""The interface of a radio that measures one frame after another, and the emulated radios."""

import dataclasses
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np

from rhs_isac_ros.frontend.waveform import N_SYMBOLS, Waveform
from rhs_isac_ros.model.geometry import frame_times_s
from rhs_isac_ros.model.multipath import complex_normal
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.support.fields import finite

# Standard deviation of the offset of the emulated carrier with one clock.
_CARRIER_STD_HZ = 300.0


class RadioFault(Exception):
    """A radio has not measured a frame."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sounding:
    """What to measure while the surface shows the configurations of a band."""

    cycle_id: int
    band: int
    symbols: np.ndarray  #: Symbols of the pilots, complex128 [F].
    arriving: np.ndarray  #: Signals of the emulated air, complex128 [F, N_SB, K].
    user: int
    #: True position of the user at the reference time of the cycle, and velocity, in the frame of
    #: the site, float64 [3].
    position_m: np.ndarray
    velocity_mps: np.ndarray
    stamp_ns: int = 0  #: Time of the pilots.


class Air:
    """The emulated air, from which emulated radios take their signals.

    Attributes
    ----------
    cycle_id, frame : int
        The present cycle, and the present frame of a band.
    signals : np.ndarray
        What arrives at the feeds in the present frame, for unit symbols, complex128 [N_SB, K].
    rng : np.random.Generator
        Source of noise and offsets.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self.cycle_id = self.frame = 0
        self.signals = np.zeros((scenario.n_subbands, scenario.n_feeds), complex)
        self.rng = rng


class Modem(Protocol):
    """Conversion of symbols to samples, and of samples to the sub-bands of the model."""

    def pilot(self, symbol: complex) -> np.ndarray:
        """Return the samples of the pilot of a frame, complex128 [n]."""
        ...

    def receive(self, cycle_id: int, captures: np.ndarray, symbols: np.ndarray, band: int,
                times_s: np.ndarray) -> np.ndarray:
        """Return the signals of a band for unit symbols, complex128 [F, N_SB, K].

        Takes one capture of each frame, complex128 [F, K, n], the symbols of the pilots, [F], and
        `Radio.time_s` of each capture, [F].
        """
        ...

    def status(self) -> Mapping[str, str]:
        """Return details for the diagnostics."""
        ...


@runtime_checkable
class Radio(Protocol):
    """A radio with a receiver at each feed."""

    @property
    def waits(self) -> bool:
        """Whether `capture` and `close` wait for hardware, so that they need a thread."""
        ...

    @property
    def modem(self) -> Modem:
        """The modem for the samples of this radio, usually a `Waveform`."""
        ...

    @property
    def time_s(self) -> float:
        """Time of the latest capture by the clock of its samples [s].

        It must be exact to a small part of the period of the carrier's offset. With one clock for
        transmitter and receiver it is always 0: there is no drift to correct.
        """
        ...

    def capture(self, band: int, pilot: np.ndarray) -> np.ndarray:
        """Return samples of all feeds that contain the pilot, complex128 [K, n].

        They must be taken after the call, as older ones belong to an earlier configuration.
        `pilot` is for a radio that also transmits. Any exception means that there is no
        measurement; after it, the next call tries again. The unit of the samples is that of the
        model, sqrt(W), and their delay is the same in all bands of a cycle.
        """
        ...

    def close(self) -> None:
        """Release the radio; the next call of `capture` opens it again."""
        ...


class EmulatedRadio:
    """A radio that measures the sub-bands of the emulated air directly, without noise.

    The base station adds the noise. Each sub-band is one sample, so the radio is its own modem.
    """

    waits, time_s = False, 0.0

    def __init__(self, scenario: Scenario, air: Air) -> None:
        self._air = air

    @property
    def modem(self) -> Modem:
        """The radio itself."""
        return self

    def pilot(self, symbol: complex) -> np.ndarray:
        """Return the symbol."""
        return np.array([symbol])

    def receive(self, cycle_id: int, captures: np.ndarray, symbols: np.ndarray, band: int,
                times_s: np.ndarray) -> np.ndarray:
        """Divide the sub-bands by the symbols."""
        return np.swapaxes(captures, 1, 2) / symbols[:, None, None]

    def status(self) -> Mapping[str, str]:
        """Return nothing."""
        return {}

    def capture(self, band: int, pilot: np.ndarray) -> np.ndarray:
        """Return the sub-bands, complex128 [K, N_SB]."""
        return (self._air.signals * pilot).T

    def close(self) -> None:
        """Do nothing."""


class WaveformRadio:
    """A radio that receives OFDM pilots from the emulated air as samples with noise.

    The delay of the samples and the offset of the carrier are unknown to the modem. They are drawn
    when the radio opens. With one clock for both ends, the phase at the start of a frame does not
    change from frame to frame.

    If all combining vectors have the same power, the combined signals have the noise of the
    scenario.

    Parameters
    ----------
    clock_ppm : float
        Excess of the user's clock over that of the receiver; 0 for one clock. It changes carrier,
        phase and delay.
    """

    waits, time_s = False, 0.0

    def __init__(self, scenario: Scenario, air: Air, *, clock_ppm: float = 0.0) -> None:
        self.modem = Waveform(scenario)
        self._drift = 1e-6 * finite('clock_ppm', clock_ppm)
        self._air = air
        times_s = frame_times_s(scenario)
        self._times_s = times_s - times_s[0, 0]
        self._centers_hz = scenario.center_frequencies_hz
        # The mean over the samples of the symbols has the noise of a feed.
        self._noise_w = (scenario.noise_power_w * scenario.n_subbands / scenario.max_power_w
                         * N_SYMBOLS * self.modem.n_period)
        self._offsets: tuple[float, float] | None = None

    def capture(self, band: int, pilot: np.ndarray) -> np.ndarray:
        """Return a frame that begins within the first two symbols, and noise around it."""
        modem, air = self.modem, self._air
        n, rate_hz = modem.n_period, modem.sample_rate_hz
        if self._offsets is None:
            # With two clocks, their drift alone determines the carrier.
            std_hz = 0.0 if self._drift else _CARRIER_STD_HZ
            self._offsets = n * air.rng.uniform(0, 2), std_hz * air.rng.normal()
        delay, carrier_hz = self._offsets
        if self._drift:
            self.time_s = float(self._times_s[band, air.frame])
        drift_hz = self._drift * self._centers_hz[band]
        delay, carrier_hz = delay - self._drift * self.time_s * rate_hz, carrier_hz + drift_hz
        sent = np.arange(-modem.n_prefix, len(pilot) - modem.n_prefix)
        amplitudes = np.conj(modem.tones(sent[-n:])) @ pilot[-n:] / n
        times = np.arange(len(pilot) + 3 * n) - modem.n_prefix - delay
        is_frame = (times >= sent[0]) & (times <= sent[-1])
        carrier = is_frame * np.exp(2j * np.pi * (
            carrier_hz / rate_hz * times + drift_hz * self.time_s))
        signals = (air.signals * amplitudes[:, None]).T @ modem.tones(times) * carrier
        return signals + np.sqrt(self._noise_w) * complex_normal(signals.shape, air.rng)

    def close(self) -> None:
        """Discard the offsets."""
        self._offsets = None
