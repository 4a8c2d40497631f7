"""Errors of band plans with imperfect synchronisation of phases, sampling times and carriers.

Problem: with the same spectrum, power and number of pilots, bands at unequal distances resolve the
range ambiguities that two bands, or equally spaced ones, leave. The estimate then relies on phase
differences between bands, so the oscillator must keep its phase when it is retuned. How large may
errors of phase, timing and carrier be before the gain is lost? The scenario declares the standard
deviations, and `bayes` averages over the unknowns. Codebooks are optimised without them.

A trial is a block of 250 positions. At 6.28 rad, the phase of each band is effectively uniform.
Timing and carrier offsets act within a band only.

Duration on two cores: three minutes with --quick, about half an hour without.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from parts import frame

from rhs_isac_ros.experiments import markdown_table, run_command
from rhs_isac_ros.experiments.sweep import BLOCK, OPTIMIZE, Point, Sweep, run_sweep, table
from rhs_isac_ros.experiments.sweep_picture import add_legend, draw_panel
from rhs_isac_ros.experiments.sweep_settings import FIELDS, Axis, Setting
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.arguments import ArgumentParser, positive_int
from rhs_isac_ros.support.pictures import PAGE_IN, new_panels, paper_style

# Seed of all positions, signals and codebooks.
SEED = 1
TRIALS, QUICK_TRIALS = 20, 1
STEPS, QUICK_STEPS = 600, 100
CURVES: Mapping[str, Sequence[float]] = {
    'band_phase_std_rad': (0, 0.1, 0.2, 0.4, 0.8, 1.6, 6.2832),
    'timing_std_s': (0, 10e-9, 100e-9, 1000e-9),
    'carrier_offset_std_hz': (0, 300, 1000, 3000, 10_000)}
PLAN = 'plan'
MEASURES = ('mse', 'error_median', 'rmse')


class Plan(NamedTuple):
    """A plan: its deviations from Table I, and the file of its codebook unless it is optimised."""

    changes: Mapping[str, Any]
    codebook: str = OPTIMIZE


PLANS = {
    '2 bands (Table I)': Plan({}),
    '4 equally spaced': Plan({
        'center_frequencies_hz': [2.5e9, 2.5e9 + 5e8 / 3, 2.5e9 + 1e9 / 3, 3.0e9],
        'n_frames': 2}),
    # Many different distances.
    '4 unequally spaced': Plan({
        'center_frequencies_hz': [2.5e9, 2.55e9, 2.7e9, 3.0e9], 'n_frames': 2})}


def read_plans(files: Mapping[str, tuple[Path, Path]]) -> dict[str, Plan]:
    """Return the built-in plans and those of pairs of a scenario and a codebook file."""
    return PLANS | {name: Plan(Scenario.from_yaml(scenario).changes(), str(codebook))
                    for name, (scenario, codebook) in files.items()}


def sweep_of(plans: Mapping[str, Plan], trials: int, steps: int) -> Sweep:
    """Return the sweep of all curves; codebooks are optimised without the errors."""
    settings = [
        Setting({PLAN: name, field: value}, Scenario(**{**plan.changes, field: value}),
                plan.codebook, 'bayes')
        for field, values in CURVES.items() for name, plan in plans.items() for value in values]
    return Sweep(Scenario(), settings, MEASURES, trials * BLOCK, SEED, steps=steps,
                 optimize_for=())


def points_of(points: Sequence[Point], plan: str, field: str, measure: str) -> list[Point]:
    """Return the points of a measure on one line of a curve, in the order of its values."""
    return [point for point in points if point.measure == measure
            and field in point.setting.varied and point.setting.varied[PLAN] == plan]


def advice(points: Sequence[Point], plans: Sequence[str]) -> list[str]:
    """Return for each plan the deviations at which its squared error doubles, and the check."""
    sentences, uniform = [], []
    for plan in plans:
        limits = []
        for field, values in CURVES.items():
            errors = [point.interval for point in points_of(points, plan, field, 'mse')]
            at = doubling(values, [error.value for error in errors])
            metadata = FIELDS[field].metadata
            label, unit = metadata['label'], metadata['declared'].unit
            quantity = label.partition(',')[0]
            limits.append(f'a {quantity} of {at:.3g} {unit}' if np.isfinite(at) else
                          f'no {quantity} up to {values[-1]:.4g} {unit}')
        sentences.append(f'{plan}: the squared error doubles at {", ".join(limits)}.')
        last = points_of(points, plan, 'band_phase_std_rad', 'mse')[-1].interval
        uniform.append('{:.2f} [{:.2f}, {:.2f}] m² ({})'.format(*last, plan))
    return [*sentences, f'With a uniform phase of each band, the error is {", ".join(uniform)}.']


def doubling(values: Sequence[float], errors: Sequence[float]) -> float:
    """Return the value at which the error is twice that at the first value, by interpolation."""
    target = 2 * errors[0]
    for k in range(1, len(errors)):
        if errors[k] >= target:
            share = (target - errors[k - 1]) / (errors[k] - errors[k - 1])
            return float(values[k - 1] + share * (values[k] - values[k - 1]))
    return np.inf


def report_of(points: Sequence[Point], plans: Sequence[str]) -> str:
    """Return a table for each curve, and the advice."""
    parts = []
    for field, values in CURVES.items():
        rows = []
        for plan in plans:
            columns = [points_of(points, plan, field, measure) for measure in MEASURES[:2]]
            rows += [[plan, f'{value:g}', *(
                '{:.3g} [{:.3g}, {:.3g}]'.format(*point.interval) for point in line)]
                for value, *line in zip(values, *columns, strict=True)]
        parts += [field, markdown_table([PLAN, 'value', 'MSE [m²]', 'median error [m]'], rows)]
    return '\n\n'.join([*parts, *advice(points, plans)])


@paper_style('drawing the figure')
def picture(points: Sequence[Point], plans: Sequence[str]) -> Any:
    """Draw a panel for each curve, with a line for each plan."""
    figure, (panels,), above = new_panels(PAGE_IN, 2.8, 1, len(CURVES), sharey=True)
    lines = Axis((PLAN,), tuple((plan,) for plan in plans))
    for panel, (field, values) in zip(panels, CURVES.items(), strict=True):
        own = [point for point in points if field in point.setting.varied]
        draw_panel(panel, Axis((field,), tuple((value,) for value in values)), [lines], own,
                   ['rmse'])
    for panel in panels[1:]:
        panel.set_ylabel('')
    add_legend(above, panels, [lines])
    return figure


def add_options(parser: ArgumentParser) -> None:
    """Add the options for further plans and for the optimisation."""
    frame.add_plans(parser, [*PLANS])
    parser.add_argument('--steps', type=positive_int, metavar='N', help='steps of an optimisation '
                        f'(default: {STEPS}, quick {QUICK_STEPS})')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = frame.experiment_options(
        'synchronisation', __doc__, TRIALS, QUICK_TRIALS, arguments, add_options)
    plans = read_plans(options.plan)
    sweep = sweep_of(plans, options.trials,
                     options.steps or (QUICK_STEPS if options.quick else STEPS))

    def reproduce() -> None:
        points = run_sweep(sweep, options.output / 'jobs', options.jobs, options.dask)
        frame.write_report(
            options, 'synchronisation', 'Synchronisation', report_of(points, list(plans)),
            picture(points, list(plans)), {'synchronisation.csv': table(sweep, points)})

    return run_command(reproduce)


if __name__ == '__main__':
    raise SystemExit(main())
