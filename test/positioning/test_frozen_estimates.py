"""Estimates stay as they are: frozen signals, with the positions that `bayes` finds for them.

The signals are in a file, so a change of the simulation does not change them. To freeze estimates
again, after a change that is meant to improve them, or another case:

    . scripts/env.sh && PYTHONPATH=. python3 test/positioning/test_frozen_estimates.py
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook, directional_codebook, random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.system import System

CONFIG = Path(__file__).parents[2] / 'config'
FILE = Path(__file__).parents[1] / 'data' / 'frozen_estimates.npz'
# Largest deviation of a mean, in standard deviations, and largest relative one of a variance in
# any direction.
MEAN, VARIANCE = 0.02, 0.02
# Scenario and codebook files, changes of the scenario, and number of shots. The region of the lab
# and the surface in the near field are small, so that the estimators are built in a second.
CASES = {
    'table1': ('table1', 'codebook', {}, 8),
    'bandplan': ('bandplan', 'codebook_bandplan', {}, 8),
    'quick': ('quick', 'codebook_quick', {}, 8),
    'lab': ('lab', 'codebook_lab', {'roi_size_m': (1.0, 1.0, 0.5)}, 2),
    'plane': ('table1', 'codebook', {'roi_size_m': (10.0, 10.0, 0.0)}, 8),
    'line': ('table1', 'codebook', {'roi_center_m': (10.0, 1.5, 0.0),
                                    'roi_size_m': (10.0, 0.0, 0.0)}, 8),
    'near field': ('scenarios/near_field', random_codebook, {
        'elements_per_side': 12, 'roi_center_m': (0.6, 0.0, 0.0),
        'roi_size_m': (0.6, 0.6, 0.4)}, 8),
    'weak signals': (
        'scenarios/weak_signal', lambda scenario, _: directional_codebook(scenario), {}, 8),
}


def case(name):
    """Return the system and the number of shots."""
    file, codebook, changes, n = CASES[name]
    whole = Scenario.from_yaml(CONFIG / f'{file}.yaml')
    scenario = dataclasses.replace(whole, **changes)
    codebook = (Codebook.load(CONFIG / f'{codebook}.yaml') if isinstance(codebook, str)
                else codebook(scenario, np.random.default_rng(0)))
    surface = load_surface(str(CONFIG / 'lab_states.npz'), whole) if name == 'lab' else None
    return System(scenario, codebook, surface), n


@pytest.mark.parametrize('name', CASES)
def test_estimates_do_not_change(name):
    system, n = case(name)
    with np.load(FILE) as frozen:
        received, mean, covariance = (
            frozen[f'{name} {key}'] for key in ('received', 'mean', 'covariance'))
    estimate = BayesEstimator(system).estimate(received)
    assert len(mean) == n
    assert estimate.fix.all()
    root = np.linalg.cholesky(covariance)
    offsets = np.linalg.solve(root, (estimate.mean - mean)[..., None])[..., 0]
    ratios = np.linalg.eigvals(np.linalg.solve(covariance, estimate.covariance)).real
    assert np.linalg.norm(offsets, axis=1).max() < MEAN
    assert np.abs(ratios - 1).max() < VARIANCE


def freeze():
    """Write signals at random positions, and the estimates for those that have a position."""
    arrays = {}
    for name in CASES:
        system, n = case(name)
        rng = np.random.default_rng(5)
        positions = system.scenario.sample_positions(2 * n, rng)
        received = system.sample(positions, rng)
        received = received.astype(np.complex64)
        estimator = BayesEstimator(system)
        received = received[estimator.estimate(received).fix][:n]
        estimate = estimator.estimate(received)
        arrays |= {f'{name} received': received, f'{name} mean': estimate.mean,
                   f'{name} covariance': estimate.covariance}
    np.savez_compressed(FILE, **arrays)


if __name__ == '__main__':
    freeze()
