"""Fig. 4 of the paper: positioning error and capacity loss by codebook and estimator.

Problem: a user is somewhere in the region of interest of Table I. The base station estimates the
position from the signals that a codebook yields, then steers the beam of band 1 there. How large
are (a) the mean squared error of the position and (b) the capacity loss due to the error? The
paper claims that, with its neural network, the optimised codebook has

(1) a mean squared error 42 % below directional's and 69 % below random's,
(2) a median capacity loss 82 % below directional's and 86 % below random's,
(3) an interquartile range of the loss 50 % below directional's and 64 % below random's.

The paper leaves open what the network takes as input, how strong the multipath is, and which
points the directional beams are focused on. Each claim is therefore tested for several readings.
The rows are `algorithm-1`, the codebook of the paper's algorithm with its settings, optimised anew
for each level of the multipath and each trial; `crlb` and `ambiguity`, the codebooks of
config/codebook_crlb.yaml (L-BFGS, 3000 steps) and config/codebook_ambiguity.yaml, both optimised
at 0 dB; `scan-width`, `scan-per-band` and `scan-grid`, three directional codebooks; and `random`,
drawn anew in each trial. The estimators are the paper's network, with one hidden layer of 256
units, retrained in every trial, and `bayes`, the posterior mean.

All rows are evaluated with the same positions, multipath and noise. Panel (b) uses the training of
each row with the smallest validation error. In rows whose codebook differs between trials, each
trial serves an equal share of the positions.

Duration on two cores: four minutes with --quick, about six hours without.
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from parts import fig4_report, frame
from parts.fig4_results import NEURAL, ROWS, Condition, Results, codebook_of

from rhs_isac_ros.codebook import Codebook, directional_codebook, optimize
from rhs_isac_ros.codebook.optimize import INTERRUPTED
from rhs_isac_ros.experiments import Job, run_command, run_jobs
from rhs_isac_ros.link import capacity, steer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.positioning.neural import INPUTS, train
from rhs_isac_ros.support.arguments import ArgumentParser, integer
from rhs_isac_ros.support.optional import optional_import
from rhs_isac_ros.system import System

TRIALS, QUICK_TRIALS = 50, 3
# Random codebooks are drawn at least this often.
MIN_DRAWS = 5
PAIRS, QUICK_PAIRS = 100_000, 20_000
POSITIONS = 10_000
QUICK_LOSSES = 500
# N_sam of Table I.
SAMPLES = 1200
LEVELS_DB = (0.0, -30.0)
QUICK_ROWS = ('algorithm-1', 'scan-width', 'scan-per-band', 'scan-grid', 'random')
QUICK_CONDITIONS = (Condition(NEURAL, 'parts', 0.0), Condition(NEURAL, 'magnitudes', -30.0),
                    Condition('bayes', '', 0.0), Condition('bayes', '', -30.0))
# Positions per job of (b).
BLOCK = 250
# Seed of the test pairs, which are the same for all; trainings use other seeds.
TEST_SEED = 1 << 20


def condition(text: str) -> Condition:
    """Parse an estimator or an input of the network and a level, for argparse."""
    name, _, level = text.partition(':')
    try:
        if name not in (*INPUTS, 'bayes') or not np.isfinite(float(level)):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r}, expected {", ".join(sorted(INPUTS))} or bayes, a colon and the level of '
            'the multipath [dB]') from None
    estimator, inputs = (name, '') if name == 'bayes' else (NEURAL, name)
    return Condition(estimator, inputs, float(level))


def optimise(scenario: Mapping[str, Any], samples: int, seed: int) -> dict:
    """Run Algorithm 1 with the settings of Table I and return the codebook's parameters."""
    result = optimize(Scenario(**scenario), method='alternating', sampling='monte_carlo',
                      n_positions=samples, seed=seed)
    if result.reason == INTERRUPTED:
        raise KeyboardInterrupt
    return result.codebook.to_parameters()


def locate(estimator: str, inputs: str, scenario: Mapping[str, Any], codebook: Mapping[str, Any],
           pairs: int, seed: int, n: int, first: int, step: int) -> dict:
    """Locate every `step`-th of the test positions, after training the network if necessary.

    Signals that give no fix are located at the centre of the region.
    """
    world, book = Scenario(**scenario), Codebook.from_parameters(codebook)
    _, received = System(world, book).pairs(n, TEST_SEED)
    received, about = received[first::step], {}
    if estimator == NEURAL:
        network = train(world, book, pairs, seed, inputs=inputs)
        means, about = network.positions(received), network.about
    else:
        means = make_estimator(estimator, world, book).estimate(received).mean
    lost = ~np.isfinite(means).all(axis=1)
    means[lost] = world.roi_center_m
    return {'means': means.round(5).tolist(), 'without_fix': int(lost.sum()),
            'validation_mse_m2': about.get('validation_mse_m2', 0.0)}


def capacity_losses(scenario: Mapping[str, Any], first: int,
                    estimates: Mapping[str, Sequence[Sequence[float]]]) -> dict:
    """Return the capacity losses of band 1 [bit/s] of a block of positions, by row."""
    world = Scenario(**scenario)
    n = len(next(iter(estimates.values())))
    # The positions do not depend on the codebook.
    truth, _ = System(world, directional_codebook(world)).pairs(n, TEST_SEED, first)

    def capacities(means: np.ndarray) -> np.ndarray:
        return np.array([capacity(world, steer(world, mean, 0), position[None])[0]
                         for mean, position in zip(means, truth, strict=True)])

    perfect = capacities(truth)
    return {name: (perfect - capacities(np.array(means))).tolist()
            for name, means in estimates.items()}


class Experiment:
    """The jobs of all conditions; those that have results are not repeated."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._trials = {row: max(options.trials, MIN_DRAWS) if row == 'random' else options.trials
                        for row in options.rows}

    def _run(self, function: Any, jobs: Sequence[Job]) -> dict[str, dict]:
        options = self._options
        results = run_jobs(
            frame.imported(function), jobs, options.output / 'jobs', options.jobs, options.dask)
        return dict(zip([job.name for job in jobs], results, strict=True))

    def codebooks(self, levels: Sequence[float]) -> dict[tuple[str, float, int], dict]:
        """Return the codebook of each row, level and trial, after optimising if necessary."""
        worlds = {level: Scenario(multipath_to_los_db=level) for level in levels}
        keys = [(row, level, trial) for level in levels for row, trials in self._trials.items()
                for trial in range(trials)]
        jobs = {key: Job(f'algorithm-1{key[1]:+g}dB-{key[2]}', {
                    'scenario': worlds[key[1]].changes(), 'samples': SAMPLES, 'seed': key[2]})
                for key in keys if key[0] == 'algorithm-1'}
        optimised = self._run(optimise, list(jobs.values()))
        return {key: optimised[jobs[key].name] if key in jobs else
                codebook_of(key[0], worlds[key[1]], key[2]).to_parameters() for key in keys}

    def results(self, conditions: Sequence[Condition]) -> Results:
        """Return the estimates in all conditions."""
        options, jobs, places = self._options, [], []
        books = self.codebooks(sorted({condition.level_db for condition in conditions}))
        for condition in conditions:
            for row, trials in self._trials.items():
                served = min(condition.trials(row, trials), options.positions)
                shared = condition.estimator != NEURAL
                for trial in range(served):
                    first, step = (trial, served) if shared else (0, 1)
                    jobs.append(Job(f'{condition.slug}-{row}-{trial}', {
                        'estimator': condition.estimator, 'inputs': condition.inputs,
                        'scenario': Scenario(multipath_to_los_db=condition.level_db).changes(),
                        'codebook': books[row, condition.level_db, trial],
                        'pairs': options.pairs if condition.estimator == NEURAL else 0,
                        'seed': trial, 'n': options.positions, 'first': first, 'step': step}))
                    places.append((condition, row, first, step))
        done = self._run(locate, jobs)
        world = Scenario()
        truth, _ = System(world, directional_codebook(world)).pairs(options.positions, TEST_SEED)
        results = Results(truth)
        for job, (condition, row, first, step) in zip(jobs, places, strict=True):
            results.add(condition, row, done[job.name], first, step)
        return results

    def add_losses(self, results: Results) -> None:
        """Compute the capacity losses of the first positions, unless there are to be none."""
        n = min(self._options.losses, self._options.positions)
        for condition in results.conditions if n else ():
            estimates = {row: results.best_estimates(condition, row) for row in self._trials}
            jobs = [Job(f'loss-{condition.slug}-{first}', {
                'scenario': Scenario(multipath_to_los_db=condition.level_db).changes(),
                'first': first, 'estimates': {
                    row: means[first:min(first + BLOCK, n)].tolist()
                    for row, means in estimates.items()}}) for first in range(0, n, BLOCK)]
            # A stored block is reused only if the estimates are still the same.
            blocks = list(self._run(capacity_losses, jobs).values())
            for row in self._trials:
                results.add_losses(condition, row, np.concatenate([b[row] for b in blocks]))


def reproduce(options: argparse.Namespace) -> None:
    """Run the experiment, print the report and write the files."""
    experiment = Experiment(options)
    results = experiment.results(options.conditions)
    experiment.add_losses(results)
    fig4_report.write(results, options)


def add_options(parser: ArgumentParser) -> None:
    """Add the options of this experiment."""
    add = parser.add_argument
    add('--pairs', type=integer(20, 10**7), metavar='N',
        help=f'pairs per training (default: {PAIRS}, quick {QUICK_PAIRS})')
    add('--positions', type=integer(1, 10**6), default=POSITIONS, metavar='N',
        help='test positions (default: %(default)s); fewer give no verdicts')
    add('--losses', type=integer(0, 10**6), metavar='N',
        help=f'positions of panel (b) (default: all, quick {QUICK_LOSSES}; 0 for none)')
    add('--rows', nargs='+', choices=ROWS, help='codebooks (default: all)')
    add('--conditions', nargs='+', type=condition, metavar='NAME:DB',
        help='estimators with the level of the multipath relative to the direct path [dB]; NAME '
             'is bayes or an input of the network, as in magnitudes:-30 bayes:0')
    add('--ros', action='store_true',
        help='measure (b) in a running network with the default codebook instead, and compare it '
             'with the library; --positions is the number of cycles')


def complete(options: argparse.Namespace) -> None:
    """Set what depends on other options: sizes, rows and conditions."""
    options.pairs = options.pairs or (QUICK_PAIRS if options.quick else PAIRS)
    options.rows = options.rows or (QUICK_ROWS if options.quick else ROWS)
    if options.losses is None:
        options.losses = QUICK_LOSSES if options.quick else options.positions
    if not options.conditions:
        readings = [(NEURAL, inputs) for inputs in sorted(INPUTS)] + [('bayes', '')]
        options.conditions = QUICK_CONDITIONS if options.quick else [
            Condition(*reading, level) for reading in readings for level in LEVELS_DB]


def over_ros(options: argparse.Namespace) -> None:
    """Measure (b) in a running network; only this needs ROS."""
    with optional_import('measuring over ROS'):
        from parts import fig4_ros
    options.output.mkdir(parents=True, exist_ok=True)
    cycles = (options.positions if options.positions != POSITIONS else
              fig4_ros.QUICK_CYCLES if options.quick else fig4_ros.CYCLES)
    fig4_ros.compare(frame.CONFIG / 'codebook.yaml', cycles, options.output)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = frame.experiment_options(
        'fig4', __doc__, TRIALS, QUICK_TRIALS, arguments, add_options)
    if options.ros:
        return run_command(lambda: over_ros(options))
    complete(options)
    return run_command(lambda: reproduce(options))


if __name__ == '__main__':
    raise SystemExit(main())
