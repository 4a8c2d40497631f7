"""Maps of the positioning error and of its bounds over the region of interest.

Problem: where in the region is the error of `bayes` large, and which bound shows it? In squares of
the horizontal plane, the maps show the root of the average Cramer-Rao bound, and the root mean
squared errors of `bayes` and of the informed estimator of the global bound. The band plans are
Table I, four equally and four unequally spaced bands, and the plans given with --plan.

A trial is a block of 250 positions of `bayes`. Codebooks are optimised against ambiguities.

Duration on two cores: two minutes with --quick, about 20 minutes without.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from parts.options import parse_options, write_results
from parts.plans import SEED, add_plan_options, read_plans

from rhs_isac_ros import __version__
from rhs_isac_ros.bounds import crlb, global_bound
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments import Job, markdown_table, run_command, run_jobs
from rhs_isac_ros.experiments.sweep import BLOCK, Sweep, run_blocks
from rhs_isac_ros.experiments.sweep_settings import Setting
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import simulate_pairs
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.pictures import PAGE_IN, new_figure, paper_style

TRIALS, QUICK_TRIALS = 40, 4
PHASES, QUICK_PHASES = 10_240, 1024
STEPS, QUICK_STEPS = 600, 100
SQUARES = 8
TITLES = {'crlb': 'root of the CRLB', 'bound': 'root of the global bound',
          'error': 'root mean squared error'}


def bound_map(scenario: Mapping[str, Any], codebook: dict[str, Any], phases: int
              ) -> dict[str, Any]:
    """Return maps of both bounds [m^2], from the phases of the global bound."""
    world, book = Scenario(**scenario), Codebook.from_parameters(codebook)
    bound = global_bound(world, book, streams.generator(SEED, streams.HELD_OUT), phases)
    local = crlb(world, book, bound.positions)
    return {'crlb': mean_map(world, bound.positions, local).tolist(),
            'bound': mean_map(world, bound.positions, bound.squared_errors).tolist()}


def mean_map(scenario: Scenario, positions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return mean values in squares of the horizontal plane, [x, y]; NaN without a position."""
    low, high = scenario.roi_bounds_m
    edges = [np.linspace(low[axis], high[axis], SQUARES + 1) for axis in (0, 1)]
    sums, counts = (np.histogram2d(positions[:, 0], positions[:, 1], edges, weights=weights)[0]
                    for weights in (values, None))
    with np.errstate(invalid='ignore'):
        means: np.ndarray = sums / counts
    return means


def maps_of(options: argparse.Namespace, phases: int, steps: int
            ) -> dict[str, dict[str, np.ndarray]]:
    """Run the jobs that have no results, and return the maps [m^2] and corners of each plan."""
    plans = read_plans(options.plan)
    folder = options.output / 'jobs'
    sweep = Sweep(
        Scenario(),
        [Setting({'plan': name}, Scenario(**plan.changes), plan.codebook, 'bayes')
         for name, plan in plans.items()],
        ['mse'], options.trials * BLOCK, SEED, steps=steps)
    maps = {}
    for setting, (codebook,), errors in run_blocks(sweep, folder, options.jobs, options.dask):
        world = setting.scenario
        case = {'scenario': world.changes(), 'codebook': codebook.to_parameters()}
        (bounds,) = run_jobs(
            bound_map, [Job(f'map-{world.id}-{codebook.id}', {**case, 'phases': phases})],
            folder, options.jobs, options.dask)
        positions, _ = simulate_pairs(world, codebook, options.trials * BLOCK, SEED)
        maps[setting.varied['plan']] = {
            **{key: np.array(bounds[key]) for key in ('crlb', 'bound')},
            'corners': world.roi_bounds_m[:, :2],
            'error': mean_map(world, positions, errors['squared_error_m2'][0])}
    return maps


@paper_style('drawing the figure')
def picture(maps: Mapping[str, Mapping[str, np.ndarray]]) -> Any:
    """Draw a row for each plan, with one scale for all maps."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import LogLocator
    figure = new_figure(PAGE_IN, 0.5 + 1.8 * len(maps))
    panels = figure.subplots(len(maps), 3, sharex=True, sharey=True, squeeze=False)
    roots = {name: {key: np.sqrt(own[key]) for key in TITLES} for name, own in maps.items()}
    values = np.concatenate([own[key].ravel() for own in roots.values() for key in TITLES])
    scale = LogNorm(np.nanmin(values), np.nanmax(values))
    for row, (name, own) in zip(panels, roots.items(), strict=True):
        for axes, key in zip(row, TITLES, strict=True):
            # left, right, bottom, top
            extent = maps[name]['corners'].T.ravel().tolist()
            image = axes.imshow(own[key].T, origin='lower', norm=scale, extent=extent)
        row[0].set_ylabel(f'{name}\n$y$ [m]')
    for axes, title in zip(panels[0], TITLES.values(), strict=True):
        axes.set_title(title)
    for axes in panels[-1]:
        axes.set_xlabel('$x$, distance from the surface [m]')
    figure.colorbar(image, ax=panels, label='error or bound [m]', aspect=12 * len(maps),
                    ticks=LogLocator(subs=(1, 2, 5)), format='%g').minorticks_off()
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse_options(
        __doc__, 'map', TRIALS, QUICK_TRIALS, arguments,
        lambda parser: add_plan_options(parser, STEPS, QUICK_STEPS))
    phases = QUICK_PHASES if options.quick else PHASES
    steps = options.steps or (QUICK_STEPS if options.quick else STEPS)

    def reproduce() -> None:
        maps = maps_of(options, phases, steps)
        rows = [[name, *('{:.3g} to {:.3g}'.format(*np.sqrt(
            [np.nanmin(own[key]), np.nanmax(own[key])])) for key in TITLES)]
            for name, own in maps.items()]
        report = markdown_table(['plan', *(f'{title} [m]' for title in TITLES.values())], rows)
        data = {name: {key: own[key].tolist() for key in TITLES} for name, own in maps.items()}
        write_results(options, 'map', 'Map', report, picture(maps), {'map.json': json.dumps(
            {'version': __version__, 'maps_m2': data}, indent=1) + '\n'})

    return run_command(reproduce)


if __name__ == '__main__':
    raise SystemExit(main())
