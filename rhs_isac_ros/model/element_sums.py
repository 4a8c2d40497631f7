"""Mean signals and their derivative from sums over the elements."""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.model.los import los_derivative_terms
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario

# Gain, radial factor, and boresight term or None, complex128 [N_SB, N, N_E].
_Terms: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray | None]
# Number of unit phasors in the table of `_phasors`.
_N_PHASORS = 512
# Memory for an array of all elements and sub-bands. Larger arrays leave the cache, and each call
# gets new pages for them from the system.
_ARRAY_BYTES = 3 << 18
_MIN_BLOCK = 8


class ElementSums:
    """Weights of the elements for the mean signals and their derivative.

    Each sum over elements of a T_i (p - p_m) is p times the sum of a T_i, minus the sum of
    a T_i p_m: sums of N_E terms that need no array of N_E by 3.

    Parameters
    ----------
    radiation
        T_i, complex128 [N_B, N_SB F, N_E].

    Attributes
    ----------
    block
        Number of positions to evaluate at a time.
    """

    def __init__(self, scenario: Scenario, radiation: np.ndarray) -> None:
        self._scenario = scenario
        shape = scenario.n_bands, scenario.n_subbands, scenario.n_frames, scenario.n_elements
        self.block = max(_ARRAY_BYTES // (16 * shape[1] * shape[3]), _MIN_BLOCK)
        self._wavenumbers = 2 * np.pi * subband_frequencies_hz(scenario) / SPEED_OF_LIGHT_MPS
        element, user = scenario.element_gain, scenario.user_gain
        self._has_pattern = isinstance(element, GainPattern) or isinstance(user, GainPattern)
        # T_i, complex128 [N_B, N_SB, N_E, F]; without a pattern, times the constant part of the
        # gain.
        frames = np.ascontiguousarray(np.swapaxes(radiation.reshape(shape), 2, 3))
        if not isinstance(element, GainPattern) and not isinstance(user, GainPattern):
            # Not in place: with one frame, the array is that of the caller.
            frames = frames * (element * user / 2 / self._wavenumbers)[..., None, None]
        self._frames = frames
        self._elements = element_positions(scenario)
        # Coordinates in which the elements differ from the origin; a plane has two.
        self._axes = np.flatnonzero(self._elements.any(axis=0))
        coordinates = np.hstack([np.ones((shape[3], 1)), self._elements[:, self._axes]])
        moments = coordinates[:, :, None] * self._frames[..., None, :]
        # T_i times 1 and the coordinates of the element [m], complex128 [N_B, N_SB, N_E, G F].
        self._moments = moments.reshape(*self._frames.shape[:3], -1)

    def terms(self, positions: np.ndarray) -> np.ndarray:
        """Compute the mean and the terms of its derivative, complex128 [N_B, N, 1 + G, N_SB F].

        The first row is the mean; `weights` multiply the others.
        """
        n, (n_bands, n_subbands, _, n_frames) = len(positions), self._frames.shape
        n_terms = 2 + len(self._axes) + self._has_pattern
        terms = np.empty((n_bands, n, n_terms, n_subbands, n_frames), complex)
        gains = self._gains_with_pattern if self._has_pattern else self._gains
        for band, (gain, radial, boresight_term) in enumerate(gains(positions)):
            frames, rows = self._frames[band], np.moveaxis(terms[band], 2, 0)
            rows[:, :, 0] = np.matmul(gain, frames)
            sums = np.matmul(radial, self._moments[band])
            rows[:, :, 1:2 + len(self._axes)] = sums.reshape(n_subbands, n, -1, n_frames)
            if self._has_pattern:
                rows[:, :, -1] = (
                    0 if boresight_term is None else np.matmul(boresight_term, frames))
        return terms.reshape(n_bands, n, n_terms, -1)

    def weights(self, positions: np.ndarray) -> np.ndarray:
        """Compute the weights of the terms for each coordinate's derivative, float64 [N, 3, G]."""
        weights = np.zeros((len(positions), 3, 1 + len(self._axes) + self._has_pattern))
        weights[:, :, 0] = positions
        weights[:, self._axes, 1 + np.arange(len(self._axes))] = -1
        if self._has_pattern:
            weights[:, 0, -1] = 1
        return weights

    def _gains(self, positions: np.ndarray) -> Iterator[_Terms]:
        """Yield `los_derivative_terms` of each band over the constant part, sub-bands first."""
        distances = np.sqrt(sum(
            (positions[:, axis, None] - self._elements[:, axis])**2 for axis in range(3)))
        inverse = 1 / distances
        minus_square = -inverse**2
        # Sub-bands are equally spaced: two phasors and a running product replace N_SB phasors.
        spacing = 2 * np.pi * self._scenario.subband_width_hz / SPEED_OF_LIGHT_MPS
        step = _phasors(-spacing * distances)
        shape = len(self._wavenumbers[0]), *distances.shape
        for wavenumbers in self._wavenumbers:
            gain, radial = np.empty(shape, complex), np.empty(shape, complex)
            gain[0] = _phasors(-wavenumbers[0] * distances)
            gain[0] *= inverse
            for subband in range(1, len(gain)):
                np.multiply(gain[subband - 1], step, out=gain[subband])
            radial.real = minus_square
            np.multiply(-wavenumbers[:, None, None], inverse, out=radial.imag)
            radial *= gain
            yield gain, radial, None

    def _gains_with_pattern(self, positions: np.ndarray) -> Iterator[_Terms]:
        """Yield `los_derivative_terms` of each band, sub-bands first."""
        for band in range(self._scenario.n_bands):
            gain, radial, boresight_term = los_derivative_terms(self._scenario, positions, band)
            yield (gain.transpose(1, 0, 2), radial.transpose(1, 0, 2),
                   None if boresight_term is None else boresight_term.transpose(1, 0, 2))


def _phasors(phases: np.ndarray) -> np.ndarray:
    """Compute exp(i phase), complex128, for phases [rad] of moderate size.

    The nearest phasor of a table is rotated by the rest of the phase with the Taylor series, which
    takes a third of the time of an exponential. The error is below 1e-15, and below that of the
    phase for large phases.
    """
    turns = phases * (_N_PHASORS / (2 * np.pi))
    nearest = np.rint(turns)
    rest = (turns - nearest) * (2 * np.pi / _N_PHASORS)
    square = rest * rest
    phasors: np.ndarray = _TABLE[nearest.astype(np.intp) & (_N_PHASORS - 1)]
    rotation = np.empty(phases.shape, complex)
    rotation.real = 1 - square * (0.5 - square * (1 / 24))
    rotation.imag = rest * (1 - square * (1 / 6 - square * (1 / 120)))
    phasors *= rotation
    return phasors


_TABLE = np.exp(2j * np.pi * np.arange(_N_PHASORS) / _N_PHASORS)
