"""Choice of the centre frequencies together with the codebook.

A band plan consists of centre frequencies on a raster. Plans are compared in three stages of
growing cost. The first evaluates the range ambiguity function in closed form, for all plans or
along a coordinate search. The second optimises codebooks briefly for a few different plans, and
the third fully for the best plans. The last two stages compare expected squared errors.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.bounds import crlb_of, global_bound
from rhs_isac_ros.bounds.range_ambiguity import range_confusion_error, range_confusion_error_of
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.optimize import OptimizeResult, optimisation, optimised, result_of
from rhs_isac_ros.codebook.unoptimised import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.jobs import HERE, Job, Strand, Workers

# Largest number of plans that are all compared; beyond it, a coordinate search selects some.
MAX_EXHAUSTIVE = 20_000
# Number of random starts of the coordinate search.
_STARTS = 8


def raster(spectrum_hz: Sequence[tuple[float, float]], raster_hz: float) -> np.ndarray:
    """Return the frequencies of the raster in the spectrum, ascending, float64 [n] [Hz].

    Raises ValueError if there is no interval, or a number is not positive or finite.
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
        errors: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return plans of ascending frequencies, float64 [P, N_B] [Hz], and their errors [P].

    If there are at most `MAX_EXHAUSTIVE` plans, with or without the gap, this function returns all
    with the gap. Otherwise, it returns the results of coordinate searches from several starts,
    which move one frequency at a time to the best one of the raster.
    """
    if math.comb(len(frequencies_hz), n_bands) > MAX_EXHAUSTIVE:
        return _coordinate_search(frequencies_hz, n_bands, gap_hz, errors, rng)
    plans = np.array(list(itertools.combinations(frequencies_hz, n_bands)))
    plans = plans[has_gap(plans, gap_hz)]
    return plans, errors(plans)


def _coordinate_search(
        frequencies_hz: np.ndarray, n_bands: int, gap_hz: float,
        errors: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Search from random plans with the gap, and from the plan of `first_fit`; see `screen`."""
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
    """Mark ascending plans whose bands are at least the gap apart, up to rounding, bool [P]."""
    return np.all(np.diff(plans, axis=1) >= gap_hz * (1 - 1e-9), axis=1)


def first_fit(frequencies_hz: np.ndarray, n_bands: int, gap_hz: float) -> np.ndarray | None:
    """Return the plan with the gap and the lowest frequencies, or None if no plan has the gap."""
    plan: list[float] = []
    for frequency in frequencies_hz:
        if not plan or frequency - plan[-1] >= gap_hz * (1 - 1e-9):
            plan.append(float(frequency))
        if len(plan) == n_bands:
            return np.array(plan)
    return None


DEFAULT_RASTER_HZ = 10e6


class Effort(NamedTuple):
    """Numbers that determine the time and the accuracy of a comparison of band plans."""

    # Assumed signal energies with an optimised codebook, relative to a random one. The screening
    # finds plans for each, because wider plans are better with more energy. Plans for 8 and above
    # would confuse directions more often, which the screening does not consider.
    energy_levels: tuple[float, ...] = (2.0, 3.0, 4.0)
    # Number of plans with a short optimisation; numbers of positions and steps of each, and of
    # shots in the global bound after it.
    candidates: int = 6
    short_positions: int = 64
    short_steps: int = 200
    short_shots: int = 1024
    # Candidates differ by at least this many steps of the raster in some frequency.
    min_difference: int = 4
    # Largest number of full optimisations, largest ratio of a candidate's error to the lowest, and
    # number of shots in the global bound after it.
    finalists: int = 3
    max_ratio: float = 1.25
    shots: int = 4096
    # A later candidate replaces the best one if the ratio of their errors is below this number.
    # Its difference from 1 is two standard errors of the global bound.
    better: float = 0.95


EFFORT = Effort()
# Number of positions for energies and errors, and number of quantiles of the energies.
_POSITIONS, _QUANTILES = 256, 16


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A band plan, with ascending centre frequencies, and its errors in the comparison."""

    frequencies_hz: tuple[float, ...]
    screening_m2: float  #: Squared error from confusing ranges, by the range ambiguity function.
    error_m2: float  #: Expected squared error with an optimised codebook; see `expected_error`.


@dataclasses.dataclass(frozen=True)
class BandPlan:
    """The result of `best_of`: a scenario with the chosen bands, and a codebook for it.

    `candidates` are the plans compared by `choose_bands`, the best one first. `error_m2` is the
    expected squared error.
    """

    scenario: Scenario
    result: OptimizeResult
    candidates: tuple[Candidate, ...]
    error_m2: float


Report: TypeAlias = Callable[[Candidate], None]


def best_of(
        scenario: Scenario, candidates: Sequence[Candidate], options: Mapping[str, Any],
        seed: int = 0, report: Report | None = None, effort: Effort = EFFORT,
        workers: Workers = HERE) -> BandPlan:
    """Optimise codebooks for the first candidates, and return the best plan.

    The candidates are in ascending order of their errors. A later plan replaces an earlier one
    only if its new error is clearly lower; candidates with much larger errors are skipped.
    `options` are those of `optimize`. `report` is called with each candidate and its new error.
    Raises ValueError if there are no candidates.
    """
    if not candidates:
        raise ValueError('candidates: none, expected at least one')
    finalists = [one for one in candidates[:effort.finalists]
                 if one.error_m2 <= effort.max_ratio * candidates[0].error_m2]
    found = workers.run([_compared(scenario, one, seed, effort.shots, report, options)
                         for one in finalists])
    best, result = found[0]
    for candidate, other in found[1:]:
        if candidate.error_m2 < effort.better * best.error_m2:
            best, result = candidate, other
    return BandPlan(with_bands(scenario, best.frequencies_hz), result, tuple(candidates),
                    best.error_m2)


def _compared(scenario: Scenario, candidate: Candidate, seed: int, n_shots: int,
              report: Report | None, options: Mapping[str, Any]
              ) -> Strand[tuple[Candidate, OptimizeResult]]:
    """Optimise a codebook for a candidate, and return the candidate with its expected error."""
    plan = with_bands(scenario, candidate.frequencies_hz)
    (found,) = yield optimised, [optimisation(plan, seed=seed, **options)]
    result = result_of(found)
    (error,) = yield _expected, [Job.of('expected', {
        'scenario': plan.changes(), 'codebook': result.codebook.to_parameters(), 'seed': seed,
        'n_shots': n_shots})]
    candidate = dataclasses.replace(candidate, error_m2=error['error_m2'])
    if report:
        report(candidate)
    return candidate, result


def _expected(scenario: Mapping[str, Any], codebook: Mapping[str, Any], seed: int, n_shots: int
              ) -> dict[str, float]:
    """Run a job: compute the expected error of a codebook."""
    return {'error_m2': expected_error(
        Scenario(**scenario), Codebook.from_parameters(dict(codebook)), seed, n_shots)}


def choose_bands(
        scenario: Scenario, spectrum_hz: Sequence[tuple[float, float]], n_bands: int, *,
        raster_hz: float = DEFAULT_RASTER_HZ, min_gap_hz: float | None = None, seed: int = 0,
        report: Report | None = None, effort: Effort = EFFORT,
        workers: Workers = HERE) -> tuple[Candidate, ...]:
    """Propose centre frequencies with which users can be located accurately.

    `spectrum_hz` are intervals of centre frequencies, including their ends. `raster_hz` is the
    spacing of frequencies from the low end of each interval. `min_gap_hz` is the smallest distance
    between two frequencies, by default the width of a band. `report` is called with each plan for
    which a codebook was optimised. Returns these plans, the best one first. Raises ValueError if
    an argument is invalid or no plan has the gap, and the errors of `Workers.run`.
    """
    if n_bands < 1 or scenario.n_bands * scenario.n_frames % n_bands:
        raise ValueError(
            f'bands: {n_bands}, expected a divisor of {scenario.n_bands * scenario.n_frames}, '
            'the number of frames of all bands')
    gap_hz = scenario.bandwidth_hz if min_gap_hz is None else min_gap_hz
    frequencies_hz = raster(spectrum_hz, raster_hz)
    if first_fit(frequencies_hz, n_bands, gap_hz) is None:
        raise ValueError(
            f'bands: {n_bands} with gaps of {gap_hz:g} Hz, expected fewer on the '
            f'{len(frequencies_hz)} frequencies of the raster')
    options = {'objective': 'error', 'n_positions': effort.short_positions,
               'max_steps': effort.short_steps}
    found = workers.run([
        _compared(scenario, Candidate(plan, screening, math.nan), seed, effort.short_shots, report,
                  options) for plan, screening in _proposals(
            scenario, frequencies_hz, n_bands, gap_hz, effort.min_difference * raster_hz,
            streams.generator(seed, streams.PLANS), effort)])
    return tuple(sorted((candidate for candidate, _ in found),
                        key=lambda candidate: candidate.error_m2))


def with_bands(scenario: Scenario, frequencies_hz: Sequence[float]) -> Scenario:
    """Return the scenario with other bands, which share the total number of frames evenly."""
    return dataclasses.replace(
        scenario, center_frequencies_hz=tuple(frequencies_hz),
        n_frames=scenario.n_bands * scenario.n_frames // len(frequencies_hz))


def _proposals(
        scenario: Scenario, frequencies_hz: np.ndarray, n_bands: int, gap_hz: float,
        difference_hz: float, rng: np.random.Generator, effort: Effort
) -> list[tuple[tuple[float, ...], float]]:
    """Return plans and their screening errors, the best of each energy level in turn."""
    spread = np.linspace(frequencies_hz[0], frequencies_hz[-1], n_bands)
    energies = _energies(with_bands(scenario, spread.tolist()))
    low, high = scenario.roi_bounds_m
    max_lag_m = float(np.linalg.norm(high - low))
    ranked = []
    for level in effort.energy_levels:
        def errors(plans: np.ndarray, level: float = level) -> np.ndarray:
            return range_confusion_error(plans, level * energies, max_lag_m)
        plans, values = screen(frequencies_hz, n_bands, gap_hz, errors, rng)
        order = np.argsort(values, kind='stable')
        ranked.append(iter(zip(plans[order], values[order], strict=True)))
    chosen: list[tuple[tuple[float, ...], float]] = []
    while ranked and len(chosen) < effort.candidates:
        source = ranked.pop(0)
        for plan, value in source:
            if all(np.abs(plan - other).max() >= difference_hz for other, _ in chosen):
                chosen.append((tuple(map(float, plan)), float(value)))
                ranked.append(source)
                break
    return chosen


def expected_error(
        scenario: Scenario, codebook: Codebook, seed: int = 0, n_shots: int = 2048) -> float:
    """Estimate the mean squared error with a codebook [m^2].

    Without nuisance parameters, the estimate is the global bound, slightly below the error.
    With nuisance parameters, which the global bound ignores, it is the average local bound with
    the region as prior, plus the squared error from confusing ranges.
    """
    rng = streams.generator(seed, streams.PLANS, 1)
    model = MeasurementModel(scenario, codebook)
    if not len(nuisance_of(scenario)):
        return global_bound(model, rng, n_shots).value
    positions = scenario.sample_positions(_POSITIONS, rng)
    return (float(crlb_of(model, positions, region_prior=True).mean())
            + range_confusion_error_of(model, positions, rng))


def _energies(scenario: Scenario) -> np.ndarray:
    """Return quantiles over the region of the whitened mean signal's energy, float64 [n]."""
    rng = streams.generator(0, streams.PLANS, 2)
    model = MeasurementModel(scenario, random_codebook(scenario, rng))
    whitened = model.whiten(model.mean(scenario.sample_positions(_POSITIONS, rng)))
    energies = np.sum(np.abs(whitened)**2, axis=(1, 2))
    # If the phase of each band is unknown, less energy is left for the comparison of phases.
    energies /= 1 + 2 * scenario.band_phase_std_rad**2 * energies / scenario.n_bands
    return np.quantile(energies, (np.arange(_QUANTILES) + 0.5) / _QUANTILES)
