"""Screening of band plans: the raster of frequencies, and a search for the best plans on it."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

# Plans that are all compared; of more, a coordinate search compares some.
MAX_EXHAUSTIVE = 20_000
# Starts of the coordinate search.
_STARTS = 8


def raster(spectrum_hz: Sequence[tuple[float, float]], raster_hz: float) -> np.ndarray:
    """Return the possible centre frequencies, ascending, float64 [n] [Hz].

    Raise ValueError if an interval or the raster is invalid.
    """
    if not 0 < raster_hz < math.inf:
        raise ValueError(f'raster: {raster_hz:g} Hz, expected a positive number')
    if not spectrum_hz:
        raise ValueError('spectrum: no interval, expected at least one')
    for low, high in spectrum_hz:
        if not 0 < low <= high < math.inf:
            raise ValueError(f'spectrum: {low:g}:{high:g}, expected LOW:HIGH with 0 < LOW <= HIGH')
    return np.unique(np.concatenate([
        low + raster_hz * np.arange(math.floor((high - low) / raster_hz * (1 + 1e-9)) + 1)
        for low, high in spectrum_hz]))


def screen(
        frequencies_hz: np.ndarray, n_bands: int, gap_hz: float,
        errors: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator,
        max_exhaustive: int = MAX_EXHAUSTIVE) -> tuple[np.ndarray, np.ndarray]:
    """Return plans with low errors, ascending float64 [P, N_B] [Hz], and the errors [P].

    Up to `max_exhaustive` plans are all evaluated. Of more, the ends of a coordinate search from
    several starts are returned: it moves one frequency at a time to its best place on the raster.
    """
    if math.comb(len(frequencies_hz), n_bands) > max_exhaustive:
        return _coordinate_search(frequencies_hz, n_bands, gap_hz, errors, rng)
    plans = np.array(list(itertools.combinations(frequencies_hz, n_bands)))
    plans = plans[has_gap(plans, gap_hz)]
    return plans, errors(plans)


def _coordinate_search(
        frequencies_hz: np.ndarray, n_bands: int, gap_hz: float,
        errors: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the searches from several starts, which are random as far as the gap permits."""
    drawn = np.sort([rng.choice(frequencies_hz, n_bands, replace=False)
                     for _ in range(_STARTS)], axis=1)
    first = first_fit(frequencies_hz, n_bands, gap_hz)
    starts = [*drawn[has_gap(drawn, gap_hz)], *([] if first is None else [first])]
    ends: dict[tuple[float, ...], float] = {}
    for plan in starts:
        value = np.inf
        while True:
            moves = np.repeat(plan[None], n_bands * len(frequencies_hz), axis=0)
            moves.reshape(n_bands, -1, n_bands)[
                np.arange(n_bands), :, np.arange(n_bands)] = frequencies_hz
            moves = np.unique(np.sort(moves, axis=1), axis=0)
            moves = moves[has_gap(moves, gap_hz)]
            values = errors(moves)
            if not values.min() < value:
                break
            plan, value = moves[values.argmin()], values.min()
        ends[tuple(plan)] = value
    return np.array(list(ends)), np.array(list(ends.values()))


def has_gap(plans: np.ndarray, gap_hz: float) -> np.ndarray:
    """Which ascending plans have a gap between all bands, up to rounding, bool [P]."""
    enough: np.ndarray = np.all(np.diff(plans, axis=1) >= gap_hz * (1 - 1e-9), axis=1)
    return enough


def first_fit(frequencies_hz: np.ndarray, n_bands: int, gap_hz: float) -> np.ndarray | None:
    """Return the plan of the lowest frequencies that have the gap, or None."""
    plan: list[float] = []
    for frequency in frequencies_hz:
        if not plan or frequency - plan[-1] >= gap_hz * (1 - 1e-9):
            plan.append(float(frequency))
        if len(plan) == n_bands:
            return np.array(plan)
    return None
