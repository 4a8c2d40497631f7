"""Accuracy on boards whose elements resonate or couple, with their own and with another codebook.

Problem: a codebook is optimised for elements with amplitudes. How large is the error of `bayes` if
the elements resonate, or if they are coupled in waveguides, and how large with a codebook that is
optimised for the board? The estimator knows the board. The codebook of the package is `shipped`.

With --steps, a codebook for the coupled board is also optimised with that many steps, once for the
board itself (`with`) and once for the same elements without their coupling (`without`).
"""

import dataclasses
import tempfile
from collections.abc import Mapping
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

CASES = (('paper', 'own'), ('resonant', 'own'), ('resonant', 'shipped'), ('coupled', 'own'),
         ('coupled', 'shipped'))


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('boards', __doc__, 3000, has_jobs=True)
    parser.add_argument('--steps', type=integer(0, 10**4), default=0,
                        help='steps of the optimisations for the coupled board; 0 to omit')
    options = parser.parse_args()
    cases = [*CASES, *(('coupled', name) for name in ('with', 'without') if options.steps)]
    found = frame.measured(options, 'boards', figures, {
        f'{board} {codebook}': {
            'board': board, 'codebook': codebook, 'steps': options.steps,
            'n': options.positions, 'seed': options.seed} for board, codebook in cases})
    print(f'{options.positions} positions, seed {options.seed}\n')
    table = frame.Table(['board', 'codebook'], {
        'MSE [m²]': ('mse_m2', 3), 'average CRLB [m²]': ('crlb_m2', 4),
        '95 % regions [%]': ('in_region', 1), 'without a fix': ('no_fix', 0)})
    results: dict[str, dict[str, Any]] = {}
    for (board, codebook), row in zip(cases, found.values(), strict=True):
        results.setdefault(board, {})[codebook] = table.row(board, codebook, **row)
    frame.write_results(options.json, results)


def codebook_of(board: str, name: str, scenario: Scenario, steps: int) -> Codebook:
    """Return a codebook for a board; optimise it if it is not in a file."""
    if name == 'shipped' or board == 'paper':
        return Codebook.default()
    if name == 'own':
        return Codebook.load(frame.CONFIG / f'codebook_{board}.yaml', scenario)
    known = scenario if name == 'with' else without_coupling(scenario)
    return optimize(known, objective='error', max_steps=steps).codebook


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


def figures(board: str, codebook: str, steps: int, n: int, seed: int) -> Mapping[str, Any]:
    """Return the error of `bayes` and the bound at random positions."""
    scenario = Scenario() if board == 'paper' else Scenario.from_yaml(
        frame.CONFIG / f'{board}.yaml')
    system = System(scenario, codebook_of(board, codebook, scenario, steps))
    positions, received = system.pairs(n, seed)
    fixes = frame.Fixes.of(BayesEstimator(system).estimate(received), positions)
    return {
        'mse_m2': frame.mean_interval(fixes.squared), 'in_region': 100 * fixes.inside.mean(),
        'crlb_m2': crlb(scenario, system.beams, positions).mean(),
        'no_fix': int(np.sum(~fixes.fix))}


if __name__ == '__main__':
    frame.run(main)
