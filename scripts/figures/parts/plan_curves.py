"""Errors and bounds of band plans over one parameter of the scenario: points and jobs."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.bounds import crlb, global_bound
from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.codebook.band_plan import choose_bands
from rhs_isac_ros.codebook.optimize import INTERRUPTED
from rhs_isac_ros.experiments import Job, run_jobs
from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.model.arguments import input_file, positive_int
from rhs_isac_ros.positioning import make_estimator, simulate_pairs

Changes = Mapping[str, Any]
# Band-frames of every plan, unless the curve varies them.
N_PILOTS = 8
LOW_HZ, HIGH_HZ = 2.5e9, 3.0e9
# Carriers as fractions of the spectrum. The unequal ones have many different distances.
SPACINGS: Mapping[str, Callable[[int], Sequence[float]]] = {
    'equal': lambda n: np.linspace(0, 1, n).tolist() if n > 1 else [0.5],
    'unequal': lambda n: {1: [0.5], 2: [0, 1], 3: [0, 0.2, 1], 4: [0, 0.1, 0.4, 1],
                          8: [k / 34 for k in (0, 1, 4, 9, 15, 22, 32, 34)]}[n]}
# Positions of a trial, and the seed of all signals.
BLOCK, SEED = 250, 1
# A bound from a coarser lattice is too loose to be drawn.
MAX_COARSENESS = 3.0
# Positions of an optimisation.
SAMPLES = 64


class Plan(NamedTuple):
    """A plan of bands: its deviations from Table I, and its codebook unless that is optimised."""

    changes: Changes
    codebook: Changes | None = None


class Curve(NamedTuple):
    """Values of one parameter.

    Attributes
    ----------
    label
        Label of the axis.
    values
        Values on the axis.
    change
        Function from a value and a plan's changes to the further changes; None varies the number
        of bands, equally spaced and chosen for the region.
    reoptimise
        Whether each value has a codebook of its own.
    bounds
        Whether to compute the bounds.
    """

    label: str
    values: Sequence[float]
    change: Callable[[float, Changes], Changes] | None
    reoptimise: bool = False
    bounds: bool = True


class Point(NamedTuple):
    """One value of a curve on one line; the codebook is that of the plan."""

    curve: str
    line: str
    value: float
    changes: Changes
    plan: Plan


def spaced(spacing: str, n_bands: int) -> Changes:
    """Return the changes of a plan with N_PILOTS band-frames."""
    fractions = SPACINGS[spacing](n_bands)
    return {'center_frequencies_hz': [LOW_HZ + (HIGH_HZ - LOW_HZ) * f for f in fractions],
            'n_frames': N_PILOTS // n_bands}


PLANS = {'2 bands (Table I)': Plan({}), '4 equally spaced': Plan(spaced('equal', 4)),
         '4 unequally spaced': Plan(spaced('unequal', 4))}


def read_plans(files: Sequence[tuple[Path, Path]]) -> dict[str, Plan]:
    """Return the built-in plans and those of pairs of a scenario and a codebook file."""
    return PLANS | {
        scenario.stem: Plan(Scenario.from_yaml(scenario).changes(),
                            plain(Codebook.load(codebook))) for scenario, codebook in files}


def add_plan_options(parser: argparse.ArgumentParser, steps: int, quick_steps: int) -> None:
    """Add the options for further plans and for the optimisation."""
    parser.add_argument('--plan', type=input_file, nargs=2, action='append', default=[],
                        metavar=('SCENARIO', 'CODEBOOK'), help='another plan and its codebook')
    parser.add_argument('--steps', type=positive_int, metavar='N',
                        help=f'steps of an optimisation (default: {steps}, quick {quick_steps})')


def plain(codebook: Codebook) -> Changes:
    """Return the parameters of a codebook as plain lists."""
    return {name: np.asarray(value).tolist() for name, value in codebook.to_parameters().items()}


def with_power(codebook: Changes, scenario: Changes) -> Changes:
    """Scale the combining vectors of a codebook to the power of a scenario."""
    if 'max_power_w' not in scenario:
        return codebook
    book = Codebook.from_parameters(codebook)
    power = np.sum(np.abs(book.digital)**2, axis=(1, 3), keepdims=True)
    return plain(Codebook(
        book.analog, book.digital * np.sqrt(scenario['max_power_w'] / power)))


def points_of(name: str, curve: Curve, plans: Mapping[str, Plan],
              chosen: Mapping[float, Changes]) -> list[Point]:
    """List the points of a curve, line by line; the chosen plans are those of `choose`."""
    if curve.change is None:
        lines = {'equally spaced': {n: spaced('equal', int(n)) for n in curve.values},
                 'chosen for the region': chosen}
        return [Point(name, line, n, of_line[n], Plan(of_line[n]))
                for line, of_line in lines.items() for n in curve.values]
    points = []
    for line, plan in plans.items():
        for value in curve.values:
            changes = {**plan.changes, **curve.change(value, plan.changes)}
            own = Plan(changes) if curve.reoptimise else plan
            points.append(Point(name, line, value, changes, own))
    return points


def choose(n_bands: int, candidates: int) -> Changes:
    """Return the changes of the plan that the optimiser of plans chooses."""
    best, *_ = choose_bands(
        Scenario(), [(LOW_HZ, HIGH_HZ)], n_bands, seed=SEED, n_candidates=candidates)
    return {'center_frequencies_hz': list(best.frequencies_hz), 'n_frames': N_PILOTS // n_bands}


def optimise(scenario: Changes, steps: int) -> Changes:
    """Return the codebook of a plan, optimised against ambiguities."""
    result = optimize(Scenario(**scenario), objective='ambiguity', n_positions=SAMPLES, seed=SEED,
                      max_steps=steps)
    if result.reason == INTERRUPTED:
        raise KeyboardInterrupt
    return plain(result.codebook)


def locate(scenario: Changes, codebook: Changes, trial: int) -> dict[str, Any]:
    """Return the squared errors of the posterior mean at a block of positions."""
    world, book = Scenario(**scenario), Codebook.from_parameters(codebook)
    positions, received = simulate_pairs(world, book, BLOCK, SEED, trial * BLOCK)
    means = make_estimator('bayes', world, book).estimate(received).mean
    means[~np.isfinite(means).all(axis=1)] = world.roi_center_m
    return {'squared_errors_m2': np.sum((means - positions)**2, axis=1).round(8).tolist()}


def bounds(scenario: Changes, codebook: Changes, phases: int) -> dict[str, Any]:
    """Return the average local bound and the global bound."""
    world, book = Scenario(**scenario), Codebook.from_parameters(codebook)
    bound = global_bound(world, book, streams.generator(SEED, streams.HELD_OUT), phases)
    return {'crlb_m2': float(crlb(world, book, bound.positions).mean()),
            'bound_m2': bound.value if bound.coarseness <= MAX_COARSENESS else np.nan,
            'bound_error_m2': bound.standard_error}


class Sizes(NamedTuple):
    """Trials of each point, phases of a bound, steps of an optimisation, and plans compared."""

    trials: int
    phases: int
    steps: int
    candidates: int = 6


def evaluate(curves: Mapping[str, Curve], plans: Mapping[str, Plan], sizes: Sizes, folder: Path,
             n_jobs: int, dask: str | None) -> list[dict[str, Any]]:
    """Run the jobs that have no results, and return an entry for each point."""
    def run(function: Callable[..., dict[str, Any]], jobs: Mapping[Any, Job]) -> dict[Any, Any]:
        return dict(zip(jobs, run_jobs(function, list(jobs.values()), folder, n_jobs, dask),
                        strict=True))

    chosen = run(choose, {n: Job(f'plan-{n}', {
        'n_bands': int(n), 'candidates': sizes.candidates})
        for curve in curves.values() if curve.change is None for n in curve.values})
    points = [point for name, curve in curves.items()
              for point in points_of(name, curve, plans, chosen)]

    wanted = {Scenario(**point.plan.changes).id: point.plan.changes for point in points
              if point.plan.codebook is None}
    books = run(optimise, {key: Job(f'codebook-{key}', {
        'scenario': changes, 'steps': sizes.steps}) for key, changes in wanted.items()})
    cases = [(point, {'scenario': point.changes, 'codebook': with_power(
        point.plan.codebook or books[Scenario(**point.plan.changes).id], point.changes)})
        for point in points]
    slugs = [f'{Scenario(**point.changes).id}-{Codebook.from_parameters(case["codebook"]).id}'
             for point, case in cases]
    located = run(locate, {
        (slug, trial): Job(f'errors-{slug}-{trial}', {**case, 'trial': trial})
        for slug, (_, case) in zip(slugs, cases, strict=True) for trial in range(sizes.trials)})
    bounded = run(bounds, {
        slug: Job(f'bounds-{slug}', {**case, 'phases': sizes.phases})
        for slug, (point, case) in zip(slugs, cases, strict=True) if curves[point.curve].bounds})
    entries = []
    for slug, point in zip(slugs, points, strict=True):
        errors = np.concatenate([located[slug, trial]['squared_errors_m2']
                                 for trial in range(sizes.trials)])
        entries.append({
            'curve': point.curve, 'line': point.line, 'value': point.value,
            'mse_m2': float(errors.mean()), 'median_m2': float(np.median(errors)),
            'mse_error_m2': float(errors.std() / np.sqrt(len(errors))), **bounded.get(slug, {})})
    return entries
