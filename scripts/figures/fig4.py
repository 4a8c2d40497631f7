"""Fig. 4 of the paper: positioning error and capacity loss by codebook and estimator.

Problem: a user is somewhere in the region of interest of Table I. The base station estimates the
position from the signals that a codebook yields, then steers its beam there. How large are (a) the
mean squared error of the position and (b) the capacity loss due to the error? The codebooks are
`optimised` (for the average CRLB, as in the paper), `ambiguity`, and the paper's benchmarks
`directional` and `random`. The estimators are `neural`, the paper's network with one hidden layer,
retrained in every trial, and `bayes`, the posterior mean. The paper claims that, with its
network, `optimised` has

(1) a mean squared error 42 % below directional's and 69 % below random's,
(2) a median capacity loss 82 % below directional's and 86 % below random's,
(3) an interquartile range of the loss 50 % below directional's and 64 % below random's.

All codebooks are evaluated with the same positions, multipath and noise; (b) uses the best
training of each.
"""

import os

# One thread per job. This must be set before NumPy is imported.
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
    run_command,
    run_jobs,
)
from rhs_isac_ros.link import CapacityReport, capacity, choose_beam
from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.model.arguments import integer
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.model.optional import optional_import
from rhs_isac_ros.positioning import NeuralEstimator, make_estimator
from rhs_isac_ros.positioning.simulate import simulate_pairs
from rhs_isac_ros.positioning.training import train

CONFIG = Path(__file__).parents[2] / 'config'
TRIALS, QUICK_TRIALS = 50, 3
PAIRS, QUICK_PAIRS = 100_000, 20_000
POSITIONS, QUICK_POSITIONS = 1000, 500
# Positions per job of (b), and per call of an estimator.
BLOCK = 50
# Seed of the test pairs, which are the same for all; trainings use other seeds.
TEST_SEED = 1 << 20


def codebooks(scenario: Scenario) -> dict[str, Codebook]:
    """Return the codebooks to compare, by name."""
    return {
        'optimised': Codebook.load(CONFIG / 'codebook_crlb.yaml'),
        'ambiguity': Codebook.load(CONFIG / 'codebook_ambiguity.yaml'),
        'directional': directional_codebook(scenario),
        'random': random_codebook(scenario, streams.generator(0, streams.START))}


def locate(estimator: str, codebook: Mapping[str, Any], n: int, pairs: int, seed: int) -> dict:
    """Locate the test positions with an estimator, after training it if necessary."""
    scenario, loaded = Scenario(), Codebook.from_parameters(codebook)
    if estimator == 'neural':
        locator = NeuralEstimator(scenario, loaded, train(scenario, loaded, pairs, seed))
    else:
        locator = make_estimator(estimator, scenario, loaded)
    positions, received = simulate_pairs(scenario, loaded, n, TEST_SEED)
    estimates = [locator.estimate(received[k:k + BLOCK]) for k in range(0, n, BLOCK)]
    means = np.concatenate([estimate.mean for estimate in estimates])
    covariances = np.concatenate([estimate.covariance for estimate in estimates])
    errors = np.sum((means - positions)**2, axis=1)
    return {'mse_m2': float(errors.mean()), 'means': means.tolist(),
            'covariances': covariances.tolist()}


def capacity_losses(first: int, estimates: Mapping[str, Mapping[str, Any]]) -> dict:
    """Return the capacity losses [bit/s, per cent] of a block of test positions by estimate."""
    scenario = Scenario()
    n = len(next(iter(estimates.values()))['means'])
    # The positions do not depend on the codebook.
    truth, _ = simulate_pairs(scenario, directional_codebook(scenario), n, TEST_SEED, first)
    perfect_bps = [choose_beam(scenario, position).expected_bps for position in truth]
    losses: dict[str, list] = {}
    for name, estimate in estimates.items():
        losses[name] = []
        for position, best_bps, mean, covariance in zip(
                truth, perfect_bps, estimate['means'], estimate['covariances'], strict=True):
            beam = choose_beam(scenario, np.array(mean), np.array(covariance)).beam
            report = CapacityReport(
                float(capacity(scenario, beam, position[None])[0]), best_bps)
            losses[name].append([report.loss_bps, report.loss_percent])
    return losses


def location_jobs(books: Mapping[str, Codebook], trials: int, pairs: int, n: int) -> list[Job]:
    """List a job for every training, and one for every codebook with `bayes`."""
    return [Job(f'{estimator}-{name}-{seed}',
                {'estimator': estimator, 'codebook': as_json(book), 'n': n, 'seed': seed,
                 'pairs': pairs if estimator == 'neural' else 0})
            for seed in range(trials) for name, book in books.items()
            for estimator in ESTIMATORS if estimator == 'neural' or seed == 0]


def as_json(codebook: Codebook) -> dict[str, Any]:
    """Return the parameters of a codebook with plain lists."""
    return {name: np.asarray(value).tolist() for name, value in codebook.to_parameters().items()}


def loss_jobs(best: Mapping[str, dict], n: int) -> list[Job]:
    """List a job for every block of positions."""
    return [Job(f'loss-{first}',
                {'first': first, 'estimates': {
                    name: {key: result[key][first:first + BLOCK]
                           for key in ('means', 'covariances')}
                    for name, result in best.items()}})
            for first in range(0, n, BLOCK)]


def measure(options: argparse.Namespace) -> Summary:
    """Run the jobs that have no results yet and summarise all."""
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
    # A stored block is reused only if the best estimates are still the same.
    blocks = run_jobs(
        capacity_losses, loss_jobs(best, options.positions), options.output / 'jobs',
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
    """Run the experiment, print the report and write the files."""
    summary = measure(options)
    report = '\n\n'.join([
        f'{options.trials} trainings with {options.pairs} pairs each; {options.positions} test '
        'positions. Mean ± standard deviation over trainings; `bayes` needs no training.',
        summary.table(),
        'Reduction relative to each benchmark with the same estimator, with 95 % intervals:',
        summary.claims()])
    for name, text in tables(summary).items():
        write_whole(options.output / name, text)
    write_whole(options.output / 'fig4.png', picture(summary))
    write_whole(options.output / 'fig4.md', f'# Fig. 4\n\n![Fig. 4](fig4.png)\n\n{report}\n')
    print(f'{report}\n\nwritten: {options.output}/fig4.png, fig4.md, fig4a.csv and fig4b.csv')


def add_sizes(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment."""
    parser.add_argument('--pairs', type=integer(20, 10**7), metavar='N',
                        help=f'pairs per training (default: {PAIRS}, quick {QUICK_PAIRS})')
    parser.add_argument('--positions', type=integer(1, 10**6), metavar='N',
                        help=f'test positions (default: {POSITIONS}, quick {QUICK_POSITIONS})')
    parser.add_argument('--ros', action='store_true',
                        help='measure (b) in a running network with the default codebook instead, '
                             'and compare it with the library; --positions is the number of '
                             'cycles')


def over_ros(options: argparse.Namespace) -> None:
    """Measure (b) in a running network; only this needs ROS."""
    with optional_import('measuring over ROS'):
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
