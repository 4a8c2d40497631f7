"""Pilots as samples: an OFDM waveform, its synchronisation, and the sub-bands in a capture.

A frame is a cyclic prefix and `N_SYMBOLS` equal symbols of duration 1 / W, with one tone in each
sub-band. Relative to the centre frequency, the tones of an even number of sub-bands are at odd
multiples of W / 2, so that each symbol is the negative of the previous one.
"""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import subband_frequencies_hz
from rhs_isac_ros.model.scenario import Scenario, ScenarioError

N_SYMBOLS = 4
# Samples of a symbol for each sub-band: half of the spectrum is left for filters.
_OVERSAMPLING = 2
# Length of the prefix in RMS delay spreads; 2 % of an exponential profile are later.
_PREFIX_SPREADS = 4.0
# Probability that noise alone stands out.
_FALSE_ALARM = 1e-6
# Standard deviation of a phase that is practically uniform.
_UNIFORM_RAD = 2 * math.pi


@dataclasses.dataclass(frozen=True)
class Synchronisation:
    """Timing and carrier of the frames of a cycle, the same in all of its bands."""

    start: int  #: First sample of the symbols in a capture, within the prefix.
    delay_s: float  #: Delay of the symbols after `start`, at most half a symbol.
    carrier_hz: float  #: Offset of the carrier within a frame.
    #: Whether the correlation of the frames exceeds that of noise alone.
    stands_out: bool


class Waveform:
    """The modem for samples: pilots as OFDM frames, and sub-bands by a Fourier transform.

    Timing and carrier are estimated from the first band of a cycle in which the frames stand out
    from the noise, and used for all later ones: an estimate for each band would destroy the
    difference of the delays between the bands, which contains the range. With two clocks, the
    carrier's offset relative to its frequency is also the drift of the clocks. From this drift and
    the times of the frames, phases and delays are turned back to the middle of that band.

    Raises ScenarioError if the scenario cannot be measured with this waveform.

    Attributes
    ----------
    sample_rate_hz : float
        Rate of the samples.
    n_prefix, n_period, n_frame : int
        Numbers of samples of the prefix, of a symbol and of a frame.
    synchronisation : Synchronisation or None
        The latest estimate of the present cycle.
    noise_power : float
        Mean power of the noise in a sub-band of the latest band, measured as the difference of
        its symbols.
    """

    def __init__(self, scenario: Scenario) -> None:
        width_hz = scenario.subband_width_hz
        self.n_period = _OVERSAMPLING * scenario.n_subbands
        self.sample_rate_hz = self.n_period * width_hz
        self.n_prefix = math.ceil(
            _PREFIX_SPREADS * scenario.delay_spread_s * self.sample_rate_hz)
        self.n_frame = self.n_prefix + N_SYMBOLS * self.n_period
        _check(scenario, self.n_frame / self.sample_rate_hz)
        self._width_hz = width_hz
        self._frequencies_hz = subband_frequencies_hz(scenario)
        self._centers_hz = scenario.center_frequencies_hz
        self.offsets_hz = self._frequencies_hz[0] - self._centers_hz[0]
        index = np.arange(scenario.n_subbands)
        # Quadratic phases keep the envelope nearly constant.
        self._phases = np.exp(1j * np.pi * index**2 / scenario.n_subbands)
        self._sign = (-1) ** (scenario.n_subbands - 1)
        self._cycle_id: int | None = None
        # Drift of the clocks, and mean time of the frames of the first band [s].
        self._drift = self._mean_s = 0.0
        self.synchronisation: Synchronisation | None = None
        self.noise_power = 0.0

    def tones(self, samples: np.ndarray) -> np.ndarray:
        """Return the tones at times [samples] from the first symbol, complex128 [N_SB, n]."""
        cycles = self.offsets_hz[:, None] / self.sample_rate_hz * samples
        return np.exp(2j * np.pi * cycles)

    def pilot(self, symbol: complex) -> np.ndarray:
        """Return the samples of a frame whose tones have the amplitude `symbol`, [n_frame]."""
        times = np.arange(-self.n_prefix, self.n_frame - self.n_prefix)
        return symbol * (self._phases @ self.tones(times))

    def receive(self, cycle_id: int, captures: np.ndarray, symbols: np.ndarray, band: int,
                times_s: np.ndarray) -> np.ndarray:
        """Return the signals of a band for unit symbols, complex128 [F, N_SB, K].

        Takes one capture of each frame, complex128 [F, K, n], the symbols of the pilots, [F], and
        the times of the frames, [F], which are all 0 with one clock.
        """
        found = self.synchronisation
        if found is None or not found.stands_out or cycle_id != self._cycle_id:
            found = self.synchronise(captures)
            self._cycle_id, self.synchronisation = cycle_id, found
            self._drift = found.carrier_hz / self._centers_hz[band]
            self._mean_s = float(times_s.mean())
        values = self.subbands(captures, dataclasses.replace(
            found, carrier_hz=self._drift * self._centers_hz[band]))
        mean = values.mean(axis=1)
        spread = np.sum(np.abs(values - mean[:, None])**2, axis=1) / (N_SYMBOLS - 1)
        self.noise_power = float(spread.mean() / N_SYMBOLS)
        cycles = self._drift * np.outer(times_s - self._mean_s, self._frequencies_hz[band])
        return mean / symbols[:, None, None] * np.exp(-2j * np.pi * cycles)[..., None]

    def status(self) -> Mapping[str, str]:
        """Return timing, carrier and noise of the present cycle; nothing without a frame."""
        found = self.synchronisation
        if found is None or not found.stands_out:
            return {}
        delay_s = found.start / self.sample_rate_hz + found.delay_s
        return {'radio.delay_s': f'{delay_s:.9f}', 'radio.carrier_hz': f'{found.carrier_hz:.1f}',
                'radio.noise_power': f'{self.noise_power:.3g}'}

    def synchronise(self, captures: np.ndarray) -> Synchronisation:
        """Estimate timing and carrier from the captures of a band, complex128 [F, K, n].

        Raises ValueError if a capture is shorter than a frame.
        """
        n = self.n_period
        if captures.shape[-1] < self.n_frame:
            raise ValueError(f'captures: {captures.shape[-1]} samples, expected at least '
                             f'{self.n_frame}')
        products = self._sign * np.sum(
            captures[..., n:] * np.conj(captures[..., :-n]), axis=(0, 1))
        # The correlation of a frame with itself, one symbol later, for each possible start.
        correlation = np.convolve(products, np.ones((N_SYMBOLS - 1) * n), 'valid')
        # It is largest for all starts within the prefix; the middle is the safest.
        plateau = np.convolve(np.abs(correlation), np.ones(self.n_prefix + 1), 'valid')
        start = int(np.argmax(plateau)) + (self.n_prefix + 1) // 2
        span = captures[..., start:start + N_SYMBOLS * n]
        n_terms = span[..., n:].size
        # The squared magnitude of the correlation of noise, relative to its energy, has the beta
        # distribution with the parameters 1 and `n_terms` - 1.
        limit = 1 - (_FALSE_ALARM / len(plateau)) ** (1 / (n_terms - 1))
        energy = np.sum(np.abs(span[..., n:])**2) * np.sum(np.abs(span[..., :-n])**2)
        found = Synchronisation(start, 0.0, self._frequency(correlation[start]),
                                bool(abs(correlation[start])**2 > limit * energy))
        # The sub-bands contain less noise than the samples.
        values = self.subbands(captures, found)
        turn = np.sum(values[:, 1:] * np.conj(values[:, :-1]))
        found = dataclasses.replace(found, carrier_hz=found.carrier_hz + self._frequency(turn))
        mean = self.subbands(captures, found).mean(axis=1)
        slope = np.sum(mean[:, 1:] * np.conj(mean[:, :-1]))
        return dataclasses.replace(
            found, delay_s=float(-np.angle(slope) / (2 * np.pi * self._width_hz)))

    def _frequency(self, turn: complex) -> float:
        """Return the frequency [Hz] of a phase per symbol."""
        return float(np.angle(turn)) * self._width_hz / (2 * np.pi)

    def subbands(self, captures: np.ndarray, found: Synchronisation) -> np.ndarray:
        """Return the sub-bands in each symbol, complex128 [F, N_SYMBOLS, N_SB, K]."""
        n, times = self.n_period, np.arange(N_SYMBOLS * self.n_period)
        carrier = np.exp(-2j * np.pi * found.carrier_hz / self.sample_rate_hz * times)
        window = captures[..., found.start:found.start + len(times)] * carrier
        symbols = window.reshape(*captures.shape[:2], N_SYMBOLS, n)
        tones = np.conj(self.tones(times)).reshape(-1, N_SYMBOLS, n)
        delays = np.conj(self._phases) * np.exp(2j * np.pi * self.offsets_hz * found.delay_s)
        return np.einsum('qksn,jsn,j->qsjk', symbols, tones, delays) / n


def _check(scenario: Scenario, frame_s: float) -> None:
    """Raise ScenarioError unless a scenario can be measured with frames of a duration [s]."""
    farthest_s = float(np.linalg.norm(
        np.abs(scenario.roi_bounds_m).max(axis=0))) / SPEED_OF_LIGHT_MPS
    if scenario.spacing_hz != scenario.subband_width_hz:
        raise ScenarioError(f'subband_spacing_hz: {scenario.subband_spacing_hz:g} Hz, expected 0 '
                            'with a waveform, whose tones fill the band')
    for name, low, tolerance, unit, reason in (
            ('frame_duration_s', frame_s, 0.0, 's', f': {N_SYMBOLS} symbols of '
             f'1 / subband_width_hz and a prefix of {_PREFIX_SPREADS:g} delay_spread_s'),
            ('timing_std_s', farthest_s, 0.0, 's',
             ', whose timing contains the delay from the region'),
            ('band_phase_std_rad', _UNIFORM_RAD * (scenario.n_bands > 1), 1e-5, 'rad',
             ', because retuning changes the phase')):
        if (value := getattr(scenario, name)) < low * (1 - tolerance):
            raise ScenarioError(f'{name}: {value:g} {unit}, expected at least {low:.5g} {unit} '
                                f'with a waveform{reason}')
