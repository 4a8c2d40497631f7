"""How well bands, sampling times and carriers have to be synchronised for a band plan to pay.

Problem: with the same spectrum, power and number of pilots, bands at unequal distances resolve the
range ambiguities that two bands, or equally spaced ones, leave. They compare phases of different
bands, so that the oscillator must keep its phase when it is retuned. Which errors of phase, timing
and carrier does the gain survive? The scenario declares the standard deviations, and `bayes`
averages over the unknowns. Codebooks are optimised without them.

A trial is a block of 250 positions. The phase of each band is uniform, in effect, at 6.28 rad.
Timing and carrier offsets act within a band only.

Duration on two cores: three minutes with --quick, about half an hour without.
"""

import os

# One thread per job. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from parts.plan_curves import Curve, Sizes, add_plan_options, evaluate, read_plans
from parts.plan_report import write

from rhs_isac_ros.experiments import parse_options, run_command

TRIALS, QUICK_TRIALS = 20, 1
STEPS, QUICK_STEPS = 600, 100
CURVES = {
    'band_phase_std_rad': Curve(
        'phase of each band, standard deviation [rad]', (0, 0.1, 0.2, 0.4, 0.8, 1.6, 6.2832),
        lambda value, plan: {'band_phase_std_rad': value}, bounds=False),
    'timing_std_s': Curve(
        'timing offset, standard deviation [ns]', (0, 10, 100, 1000),
        lambda value, plan: {'timing_std_s': 1e-9 * value}, bounds=False),
    'carrier_offset_std_hz': Curve(
        'carrier offset, standard deviation [kHz]', (0, 0.3, 1, 3, 10),
        lambda value, plan: {'carrier_offset_std_hz': 1e3 * value}, bounds=False)}


def advice(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return for each plan the deviations at which its squared error doubles, and the check."""
    lines = list(dict.fromkeys(entry['line'] for entry in entries))
    sentences = []
    for line in lines:
        limits = []
        for name, curve in CURVES.items():
            errors = [entry['mse_m2'] for entry in entries
                      if (entry['line'], entry['curve']) == (line, name)]
            unit = curve.label.rpartition('[')[2].rstrip(']')
            at = doubling(curve.values, errors)
            quantity = curve.label.partition(',')[0]
            limits.append(f'a {quantity} of {at:.3g} {unit}' if np.isfinite(at) else
                          f'no {quantity} up to {curve.values[-1]:.4g} {unit}')
        sentences.append(f'{line}: the squared error doubles at {", ".join(limits)}.')
    uniform = [next(entry for entry in reversed(entries)
                    if (entry['line'], entry['curve']) == (line, 'band_phase_std_rad'))
               for line in lines]
    numbers = ', '.join(f'{entry["mse_m2"]:.2f} ± {2 * entry["mse_error_m2"]:.2f} m² ({line})'
                        for line, entry in zip(lines, uniform, strict=True))
    return [*sentences, f'With a uniform phase of each band, the error is {numbers}.']


def doubling(values: Sequence[float], errors: Sequence[float]) -> float:
    """Return the value at which the error is twice that at the first value, by interpolation."""
    target = 2 * errors[0]
    for k in range(1, len(errors)):
        if errors[k] >= target:
            share = (target - errors[k - 1]) / (errors[k] - errors[k - 1])
            return float(values[k - 1] + share * (values[k] - values[k - 1]))
    return np.inf


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment."""
    add_plan_options(parser, STEPS, QUICK_STEPS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse_options(
        __doc__, 'synchronisation', TRIALS, QUICK_TRIALS, arguments, add_options)
    sizes = Sizes(options.trials, 0, options.steps or (QUICK_STEPS if options.quick else STEPS))

    def reproduce() -> None:
        entries = evaluate(CURVES, read_plans(options.plan), sizes, options.output / 'jobs',
                           options.jobs, options.dask)
        write('synchronisation', CURVES, entries, advice(entries), options.output,
              options.format)

    return run_command(reproduce)


if __name__ == '__main__':
    raise SystemExit(main())
