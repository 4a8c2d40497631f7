"""Accuracy on boards whose elements resonate or couple, with their own and with another codebook.

Problem: a codebook is optimised for elements with amplitudes. How large is the error of `bayes` if
the elements resonate, or if they are coupled in waveguides, and how large with a codebook that is
optimised for the board? The estimator knows the board. The codebook of the package is `shipped`.

With --steps, a codebook for the coupled board is also optimised with that many steps, once for the
board itself (`with`) and once for the same elements without their coupling (`without`).
"""

import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.network import CoupledNetwork
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.support.arguments import integer
from rhs_isac_ros.support.files import read_arrays, write_archive
from rhs_isac_ros.system import System


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('boards', __doc__, 3000)
    parser.add_argument('--steps', type=integer(0, 10**4), default=0,
                        help='steps of the optimisations for the coupled board; 0 to omit')
    options = parser.parse_args()
    print(f'{options.positions} positions, seed {options.seed}\n')
    table = frame.Table(['board', 'codebook'], {
        'MSE [m²]': ('mse_m2', 3), 'average CRLB [m²]': ('crlb_m2', 4),
        '95 % regions [%]': ('in_region', 1), 'without a fix': ('no_fix', 0)})
    results: dict[str, dict[str, Any]] = {}
    for board, scenario, codebooks in cases(options.steps):
        for name, codebook in codebooks:
            results.setdefault(board, {})[name] = table.row(
                board, name, **figures(scenario, codebook, options.positions, options.seed))
    frame.write_results(options.json, results)


def cases(steps: int) -> Iterator[tuple[str, Scenario, list[tuple[str, Codebook]]]]:
    """Yield boards with their scenarios and codebooks."""
    shipped = Codebook.default()
    yield 'paper', Scenario(), [('own', shipped)]
    for board in ('resonant', 'coupled'):
        scenario = Scenario.from_yaml(frame.CONFIG / f'{board}.yaml')
        own = Codebook.load(frame.CONFIG / f'codebook_{board}.yaml', scenario)
        yield board, scenario, [('own', own), ('shipped', shipped)]
    if steps:
        yield 'coupled', scenario, [
            (name, optimize(known, objective='error', max_steps=steps).codebook)
            for name, known in (('with', scenario), ('without', without_coupling(scenario)))]


def without_coupling(scenario: Scenario) -> Scenario:
    """Return a scenario whose elements have the same loads, but do not couple."""
    board = scenario.board
    assert isinstance(board, CoupledNetwork)
    arrays = read_arrays(board.file.rpartition('@')[0])
    arrays['y_ss'] = arrays['y_ss'] * np.eye(scenario.n_elements)
    arrays.pop('about', None)
    with tempfile.TemporaryDirectory() as folder:
        write_archive(Path(folder) / 'alone.npz', arrays, {})
        alone = CoupledNetwork(file=f'{folder}/alone.npz')
        alone.network  # noqa: B018 - read before the file is deleted
    return dataclasses.replace(scenario, board=alone)


def figures(scenario: Scenario, codebook: Codebook, n: int, seed: int) -> dict[str, Any]:
    """Return the error of `bayes` and the bound at random positions."""
    system = System(scenario, codebook)
    positions, received = system.pairs(n, seed)
    fixes = frame.Fixes.of(BayesEstimator(system).estimate(received), positions)
    return {
        'mse_m2': frame.mean_interval(fixes.squared), 'in_region': 100 * fixes.inside.mean(),
        'crlb_m2': crlb(scenario, codebook, positions).mean(), 'no_fix': int(np.sum(~fixes.fix))}


if __name__ == '__main__':
    frame.run(main)
