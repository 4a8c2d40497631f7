"""The jobs of a sweep: codebooks, and quantities at blocks of positions."""

import functools
import json
import threading
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.special import chdtri
from scipy.stats import qmc

from rhs_isac_ros.bounds import crlb, global_bound
from rhs_isac_ros.codebook import Codebook, directional_codebook, optimize, random_codebook
from rhs_isac_ros.codebook.optimize import INTERRUPTED
from rhs_isac_ros.link import capacity as capacity_of
from rhs_isac_ros.link import capacity_report, choose_beam
from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.positioning import Estimator, make_estimator, simulate_pairs

# Kinds of codebooks that are made for a scenario.
OPTIMIZE, DIRECTIONAL, RANDOM = 'optimize', 'directional', 'random'
KINDS = (OPTIMIZE, DIRECTIONAL, RANDOM)
# Positions of a job. A different size changes the positions of the global bound.
BLOCK = 250
# Samples of an optimisation.
_SAMPLES = 64
# Squared Mahalanobis radius of the 95 % region.
_RADIUS = float(chdtri(3, 0.05))
# A global bound from a coarser lattice is too loose.
_MAX_COARSENESS = 3.0
# Relative deviation of the power that needs no scaling, below that of `Codebook.check`.
_POWER_TOLERANCE = 1e-9
# Families of quantities that one job computes. Each of the last three includes those before it.
CRLB, BOUND, ERROR, CAPACITY, LOSS = 'crlb', 'bound', 'error', 'capacity', 'loss'
_QUANTITIES = {
    CRLB: ('crlb_m2',), BOUND: ('bound_m2',), ERROR: ('squared_error_m2', 'inside', 'fix'),
    CAPACITY: ('capacity_bps',), LOSS: ('perfect_bps', 'loss_bps')}
_INCLUSIVE = (ERROR, CAPACITY, LOSS)
_FIRST_SOBOL = threading.Lock()


def families(quantities: Iterable[str]) -> list[str]:
    """Return the families whose jobs compute all of some quantities."""
    wanted = set(quantities)
    found = [family for family, names in _QUANTITIES.items() if wanted.intersection(names)]
    return [family for family in found if family not in _INCLUSIVE] + [
        family for family in found if family in _INCLUSIVE][-1:]


def plain_codebook(codebook: Codebook) -> dict[str, Any]:
    """Return the parameters of a codebook as plain lists."""
    return {name: np.asarray(value).tolist() for name, value in codebook.to_parameters().items()}


def with_power(codebook: Codebook, power_w: float) -> Codebook:
    """Scale the combining vectors of a codebook so that each frame has a power.

    A codebook that has this power remains the same, with its id.
    """
    power = np.sum(np.abs(codebook.digital)**2, axis=(1, 3), keepdims=True)
    if np.allclose(power, power_w, rtol=_POWER_TOLERANCE, atol=0):
        return codebook
    return Codebook(codebook.analog, codebook.digital * np.sqrt(power_w / power))


def design(scenario: Mapping[str, Any], kind: str, seed: int, objective: str = '',
           steps: int = 0) -> dict[str, Any]:
    """Make a codebook of one of `KINDS`, and return its parameters.

    The scenario is given by the fields that differ from Table I. Only an optimisation has an
    objective and steps.
    """
    world = Scenario(**scenario)
    if kind == DIRECTIONAL:
        return plain_codebook(directional_codebook(world))
    if kind == RANDOM:
        return plain_codebook(random_codebook(world, streams.generator(seed, streams.START)))
    _initialise_sobol()
    result = optimize(world, objective=objective, n_positions=_SAMPLES, seed=seed,
                      max_steps=steps)
    if result.reason == INTERRUPTED:
        raise KeyboardInterrupt
    return plain_codebook(result.codebook)


def evaluate(family: str, scenario: Mapping[str, Any], codebook: Mapping[str, Any], seed: int,
             first: int, n: int, estimator: str = '') -> dict[str, list[float]]:
    """Compute the quantities of a family at positions `first` to ``first + n`` of a sequence.

    The seed determines the sequence, which is the same for all scenarios with the same region.
    Lists of the result have a value for each position.
    """
    world, book = Scenario(**scenario), Codebook.from_parameters(dict(codebook))
    if family == BOUND:
        bound = global_bound(
            world, book, streams.generator(seed, streams.HELD_OUT, first), n)
        loose = bound.coarseness > _MAX_COARSENESS
        return {'bound_m2': [np.nan] * n if loose else bound.squared_errors.tolist()}
    positions, received = simulate_pairs(world, book, n, seed, first)
    if family == CRLB:
        return {'crlb_m2': crlb(world, book, positions).tolist()}
    located = _estimator(estimator, json.dumps(scenario), json.dumps(codebook)).estimate(received)
    fix = located.fix
    # Without a fix, only the region is known.
    mean = np.where(fix[:, None], located.mean, world.roi_center_m)
    covariance = np.where(
        fix[:, None, None], located.covariance, np.diag(np.square(world.roi_size_m) / 12))
    error = mean - positions
    distance = np.einsum('na,nab,nb->n', error, np.linalg.pinv(covariance, hermitian=True), error)
    result = {'squared_error_m2': np.sum(error**2, axis=1), 'fix': fix.astype(float),
              'inside': (fix & (distance <= _RADIUS)).astype(float)}
    if family in (CAPACITY, LOSS):
        beams = [choose_beam(world, *known).beam for known in zip(mean, covariance, strict=True)]
        pairs = list(zip(beams, positions, strict=True))
        if family == CAPACITY:
            result['capacity_bps'] = np.array(
                [capacity_of(world, beam, position[None])[0] for beam, position in pairs])
        else:
            reports = [capacity_report(world, beam, position) for beam, position in pairs]
            result['capacity_bps'] = np.array([report.actual_bps for report in reports])
            result['perfect_bps'] = np.array([report.perfect_bps for report in reports])
            result['loss_bps'] = np.array([report.loss_bps for report in reports])
    return {name: values.tolist() for name, values in result.items()}


@functools.lru_cache(maxsize=1)
def _estimator(name: str, scenario: str, codebook: str) -> Estimator:
    """Return an estimator for a scenario and a codebook as JSON, the same for successive jobs."""
    _initialise_sobol()
    return make_estimator(name, Scenario(**json.loads(scenario)),
                          Codebook.from_parameters(json.loads(codebook)))


def _initialise_sobol() -> None:
    """Create a Sobol sequence, of which only one thread of a cluster's worker may be the first.

    SciPy reads its table of direction numbers for the first sequence of a process, without a lock.
    """
    with _FIRST_SOBOL:
        qmc.Sobol(1)
