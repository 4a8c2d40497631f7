"""Fig. 4 of the paper: positioning error and capacity loss by codebook and estimator.

Problem: at Table I, a user is somewhere in the region of interest. The base station estimates
where from the signals that one codebook gives, then steers its beam there. How large is (a) the
mean squared error of the position, and (b) the capacity that the error costs? The codebooks are
`optimised` (for the average CRLB, as in the paper), `ambiguity`, and the paper's benchmarks
`directional` and `random`. The estimators are `neural`, the paper's network of one hidden layer,
trained anew in every trial, and `bayes`, the posterior mean. The paper claims that, with its
network, `optimised` has

(1) a mean squared error 42 % below directional's and 69 % below random's,
(2) a median capacity loss 82 % below directional's and 86 % below random's,
(3) an interquartile range of the loss 50 % below directional's and 64 % below random's.

All codebooks face the same positions, multipath and noise; (b) takes the best training of each.
"""

import os

# One thread for each job. This must come before NumPy is loaded.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from parts.fig4_report import ESTIMATORS, Summary, picture, tables

from rhs_isac_ros.codebook import Codebook, directional_codebook, random_codebook
from rhs_isac_ros.experiments import (
    Job,
    parse_options,
    positive,
    run_command,
    run_jobs,
)
from rhs_isac_ros.experiments.libraries import needed_for
from rhs_isac_ros.link import Outcome, capacity, choose_beam
from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.positioning import NeuralEstimator, make_estimator
from rhs_isac_ros.positioning.simulate import simulate_pairs
from rhs_isac_ros.positioning.training import train

CONFIG = Path(__file__).parents[2] / 'config'
TRIALS, QUICK_TRIALS = 50, 3
PAIRS, QUICK_PAIRS = 100_000, 20_000
POSITIONS, QUICK_POSITIONS = 1000, 500
# Positions of a job of (b), and of a call of an estimator.
BLOCK = 50
# The sequence of pairs that all are measured on; trainings draw others.
TEST_SEED = 1 << 20


def codebooks(scenario: Scenario) -> dict[str, Codebook]:
    """The codebooks to compare."""
    return {
        'optimised': Codebook.load(CONFIG / 'codebook_crlb.yaml'),
        'ambiguity': Codebook.load(CONFIG / 'codebook_ambiguity.yaml'),
        'directional': directional_codebook(scenario),
        'random': random_codebook(scenario, streams.generator(0, streams.START))}


def locate(estimator: str, codebook: Mapping[str, Any], n: int, pairs: int, seed: int) -> dict:
    """Locate the test positions with an estimator, trained first if it has to be."""
    scenario, known = Scenario(), Codebook.from_parameters(codebook)
    if estimator == 'neural':
        locator = NeuralEstimator(scenario, known, train(scenario, known, pairs, seed))
    else:
        locator = make_estimator(estimator, scenario, known)
    positions, received = simulate_pairs(scenario, known, n, TEST_SEED)
    estimates = [locator.estimate(received[k:k + BLOCK]) for k in range(0, n, BLOCK)]
    means = np.concatenate([estimate.mean for estimate in estimates])
    covariances = np.concatenate([estimate.covariance for estimate in estimates])
    errors = np.sum((means - positions)**2, axis=1)
    return {'mse_m2': float(errors.mean()), 'means': means.tolist(),
            'covariances': covariances.tolist()}


def lose(first: int, estimates: Mapping[str, Mapping[str, Any]]) -> dict:
    """Capacity losses [bit/s, per cent] of some test positions, for everybody's estimates."""
    scenario = Scenario()
    n = len(next(iter(estimates.values()))['means'])
    # Positions do not depend on the codebook.
    truth, _ = simulate_pairs(scenario, directional_codebook(scenario), n, TEST_SEED, first)
    perfect_bps = [choose_beam(scenario, place).expected_bps for place in truth]
    losses: dict[str, list] = {}
    for name, estimate in estimates.items():
        losses[name] = []
        for place, best_bps, mean, covariance in zip(
                truth, perfect_bps, estimate['means'], estimate['covariances'], strict=True):
            beam = choose_beam(scenario, np.array(mean), np.array(covariance)).beam
            one = Outcome(float(capacity(scenario, beam, place[None])[0]), best_bps)
            losses[name].append([one.loss_bps, one.loss_percent])
    return losses


def location_jobs(books: Mapping[str, Codebook], trials: int, pairs: int, n: int) -> list[Job]:
    """A job for every training, and one for every codebook with `bayes`."""
    return [Job(f'{estimator}-{name}-{seed}',
                {'estimator': estimator, 'codebook': plain(book), 'n': n, 'seed': seed,
                 'pairs': pairs if estimator == 'neural' else 0})
            for seed in range(trials) for name, book in books.items()
            for estimator in ESTIMATORS if estimator == 'neural' or seed == 0]


def plain(codebook: Codebook) -> dict[str, Any]:
    """A codebook as JSON holds it, without what is told of it."""
    return {name: np.asarray(value).tolist() for name, value in codebook.to_parameters().items()}


def loss_jobs(best: Mapping[str, dict], n: int) -> list[Job]:
    """A job for every block of positions."""
    return [Job(f'loss-{first}',
                {'first': first, 'estimates': {
                    name: {key: result[key][first:first + BLOCK]
                           for key in ('means', 'covariances')}
                    for name, result in best.items()}})
            for first in range(0, n, BLOCK)]


def measure(options: argparse.Namespace) -> Summary:
    """Run what is not done yet."""
    books = codebooks(Scenario())
    jobs = location_jobs(books, options.trials, options.pairs, options.positions)
    results = dict(zip([job.name for job in jobs], run_jobs(
        locate, jobs, options.output / 'jobs', options.jobs, options.dask), strict=True))
    trials = {(estimator, name): [results[f'{estimator}-{name}-{seed}']
                                  for seed in range(options.trials)
                                  if f'{estimator}-{name}-{seed}' in results]
              for estimator in ESTIMATORS for name in books}
    best = {f'{estimator} {name}': min(entries, key=lambda entry: entry['mse_m2'])
            for (estimator, name), entries in trials.items()}
    # Blocks belong to the estimates that were the best when they were done.
    blocks = run_jobs(lose, loss_jobs(best, options.positions), options.output / 'jobs',
                      options.jobs, options.dask)
    truth, _ = simulate_pairs(
        Scenario(), books['directional'], options.positions, TEST_SEED)
    losses = {}
    for name, entry in best.items():
        errors = np.sum((np.array(entry['means']) - truth)**2, axis=1)
        rows = np.concatenate([block[name] for block in blocks])
        losses[name] = np.column_stack([rows, errors])
    return Summary(
        list(books), {key: np.array([entry['mse_m2'] for entry in entries])
                      for key, entries in trials.items()}, losses)


def reproduce(options: argparse.Namespace) -> None:
    """Measure, print the report and write the files."""
    summary = measure(options)
    report = '\n\n'.join([
        f'{options.trials} trainings with {options.pairs} pairs each; {options.positions} test '
        'positions. Mean ± standard deviation over trainings; `bayes` needs none.',
        summary.table(),
        'How far below each benchmark with the same estimator, with 95 % intervals:',
        summary.claims()])
    for name, text in tables(summary).items():
        write_whole(options.output / name, text)
    write_whole(options.output / 'fig4.png', picture(summary))
    write_whole(options.output / 'fig4.md', f'# Fig. 4\n\n![Fig. 4](fig4.png)\n\n{report}\n')
    print(f'{report}\n\nwritten: {options.output}/fig4.png, fig4.md, fig4a.csv and fig4b.csv')


def add_sizes(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment."""
    parser.add_argument('--pairs', type=positive, metavar='N',
                        help=f'pairs of a training (default: {PAIRS}, quick {QUICK_PAIRS})')
    parser.add_argument('--positions', type=positive, metavar='N',
                        help=f'test positions (default: {POSITIONS}, quick {QUICK_POSITIONS})')
    parser.add_argument('--ros', action='store_true',
                        help='measure (b) through a running network instead, with the default '
                             'codebook, and compare; --positions counts cycles')


def over_ros(options: argparse.Namespace) -> None:
    """Measure (b) through a running network; only this needs ROS."""
    with needed_for('measuring over ROS'):
        from parts import fig4_ros
    options.output.mkdir(parents=True, exist_ok=True)
    cycles = options.positions or (fig4_ros.QUICK_CYCLES if options.quick else fig4_ros.CYCLES)
    fig4_ros.compare(CONFIG / 'codebook.yaml', cycles, options.output)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse_options(__doc__, 'fig4', TRIALS, QUICK_TRIALS, arguments, add_sizes)
    if options.ros:
        return run_command(lambda: over_ros(options))
    options.pairs = options.pairs or (QUICK_PAIRS if options.quick else PAIRS)
    options.positions = options.positions or (QUICK_POSITIONS if options.quick else POSITIONS)
    return run_command(lambda: reproduce(options))


if __name__ == '__main__':
    raise SystemExit(main())
