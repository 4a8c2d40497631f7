"""A bound on the mean squared error that includes ambiguities: the error of an informed estimator.

The estimator is also given q modulo a lattice, where q = (r, u, v) are range and direction
cosines, so that only points p_k of a lattice remain for the position p. ``docs/bounds.rst``
derives the bound from the log-likelihood of p_k relative to that of p,
-d_k^H d_k + 2 Re(d_k^H n), with the whitened differences d_k of the mean signals and noise n of
unit covariance, which is drawn at random.

Steps of up to 2.4 local standard deviations lose little, because even such coarse samples of a
Gaussian have almost its exact variance.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import blocks, mixture_weights
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import jacobian, polar_bounds, to_polar
from rhs_isac_ros.support.fields import whole
from rhs_isac_ros.support.threads import one_blas_thread

# Lattice steps of (r, u, v), in standard deviations of one coordinate with the others known, and
# the smallest number of steps across the region. With Table I, the bound changes by (1 +- 2) % if
# the steps across the line of sight are half as large.
_STEPS = np.array([2.4, 1.2, 1.2])
_MIN_STEPS = 24
# Maximum number of lattice points in the box around the region; to keep it, steps are enlarged.
_MAX_POINTS = 2_000_000
# Number of positioning phases that share an offset of the lattice, and number evaluated at a time.
_PER_OFFSET = 512
_BLOCK = 16
# Points whose log-likelihood is lower than the true point's by more than this are neglected.
_MARGIN = 20.0
# Nodes of the interpolation over the range, in addition to those for the phase of the sub-bands,
# and number of ranges at which the likelihood of a ray is bounded.
_N_NODES = 10
_N_CHECKS = 64


class GlobalBound(NamedTuple):
    """Bound on the mean squared error of any estimator, for a uniform prior on the region."""

    value: float  #: The bound [m^2].
    standard_error: float  #: Standard error of `value`, a Monte-Carlo average [m^2].
    positions: np.ndarray  #: Positions of the simulated phases, float64 [n, 3] [m].
    squared_errors: np.ndarray  #: Squared errors of the informed estimator, float64 [n] [m^2].
    #: Factor by which the limit on the number of lattice points has enlarged the steps; 1 if the
    #: lattice resolves the posterior. Above about 3, the bound is loose.
    coarseness: float


@one_blas_thread
def global_bound(
        model: MeasurementModel, rng: np.random.Generator, n_phases: int = 2048) -> GlobalBound:
    """Compute the bound from the posteriors of `n_phases` random positioning phases.

    The bound holds for a synchronised user: nuisance parameters of the scenario are not included.
    Raises ValueError if `n_phases` is less than 2.
    """
    n_phases = whole('n_phases', n_phases, 2)
    steps, coarseness = _steps(model.prepare(), rng)
    parts = []
    for first in range(0, n_phases, _PER_OFFSET):
        # A random position as the offset makes the positions of all phases uniform.
        lattice = _Lattice(model, steps, model.scenario.sample_positions(1, rng)[0])
        parts.append(np.stack(list(lattice.phases(min(_PER_OFFSET, n_phases - first), rng))))
    moments = np.concatenate(parts)
    # The variance of the posterior has the same mean as the squared error, and a smaller spread.
    variances = moments[:, 3]
    return GlobalBound(
        float(variances.mean()), float(variances.std(ddof=1) / np.sqrt(n_phases)),
        moments[:, :3], moments[:, 4], coarseness)


class _Lattice:
    """Points, inside the region of interest, of a lattice in (r, u, v) that contains `point`.

    Along a ray, the mean signals of a band are a carrier times a smooth function of the range,
    which is interpolated between Chebyshev nodes. All ranges of a ray then cost one product of
    small matrices. Rays on which no point is likely, for any phases of the carriers, are skipped.
    """

    def __init__(self, model: MeasurementModel, steps: np.ndarray, point: np.ndarray) -> None:
        self._model, scenario = model, model.scenario
        given, box = to_polar(point), polar_bounds(scenario.roi_bounds_m)
        ranges, *directions = (
            np.arange(q - np.ceil((q - low) / step) * step, high + step, step)
            for q, low, high, step in zip(given, *box, steps, strict=True))
        u, v = (axis.ravel() for axis in np.meshgrid(*directions, indexing='ij'))
        sight = np.stack([np.sqrt(np.maximum(1 - u**2 - v**2, 0)), u, v], axis=1)
        inside = np.ones((len(sight), len(ranges)), bool)
        thickness: np.ndarray | float = 1.0
        for axis, (least, most) in enumerate(scenario.roi_bounds_m.T):
            coordinate, cell = sight[:, axis, None] * ranges, steps[axis] * (ranges if axis else 1)
            # A region thinner than a cell of the lattice is given the thickness of a cell.
            excess = np.maximum(cell - (most - least), 0) / 2
            inside &= (coordinate >= least - excess) & (coordinate <= most + excess)
            if np.any(excess):
                thickness = thickness * (most - least + 2 * excess)
        self._extends = np.ptp(scenario.roi_bounds_m, axis=0) > 0
        used = inside.any(axis=1)
        sight, inside = sight[used], inside[used]
        self._sight, self._ranges = sight, ranges
        with np.errstate(divide='ignore'):
            # The density of (r, u, v) is the density of the position times r^2 / w.
            self._prior = np.log(np.where(inside, ranges**2 / thickness / sight[:, :1], 0.0))
        self._interpolate(sight, ranges, box[:, 0])

    def _interpolate(self, sight: np.ndarray, ranges: np.ndarray, limits: np.ndarray) -> None:
        """Compute the signals at the nodes, and weights that interpolate them to all ranges."""
        model, scenario = self._model, self._model.scenario
        span_hz = scenario.bandwidth_hz
        turns = span_hz * np.ptp(limits) / SPEED_OF_LIGHT_MPS
        n_nodes = _N_NODES + int(np.ceil(2 * np.pi * turns))
        middle, half = np.mean(limits), max(np.ptp(limits) / 2, np.finfo(float).tiny)
        scaled = chebyshev.chebpts1(n_nodes)
        nodes = middle + half * scaled
        at_nodes, *wanted = (chebyshev.chebvander(points, n_nodes - 1).T for points in (
            scaled, (ranges - middle) / half, np.linspace(-1, 1, _N_CHECKS)))
        # Weights that interpolate from the nodes, [nodes, points].
        at_ranges, self._at_checks = (np.linalg.solve(at_nodes, one) for one in wanted)
        wavenumbers = 2 * np.pi * np.array(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS
        signals = model.whiten(model.mean((sight[:, None] * nodes[:, None]).reshape(-1, 3)))
        signals = signals.reshape(len(sight), n_nodes, *model.shape)
        carriers = nodes[:, None] * np.exp(1j * nodes[:, None] * wavenumbers)
        # [bands, measurements, rays nodes]
        smooth = np.moveaxis(signals * carriers[..., None], (2, 3), (0, 1))
        self._smooth = smooth.reshape(*model.shape, -1)
        phases = ranges * wavenumbers[:, None]
        basis = np.stack([np.cos(phases), np.sin(phases)], axis=1)[:, None]
        # Re(z exp(-i k r)) = Re z cos k r + Im z sin k r: [bands, nodes, 2, ranges].
        basis = 2 * basis * (at_ranges / ranges)[:, None]
        self._basis = basis.reshape(-1, len(ranges)).astype(np.float32)
        energy = np.sum(np.abs(smooth)**2, axis=(0, 1))
        self._offset = (self._prior - energy @ at_ranges / ranges**2).astype(np.float32)
        self._energy = np.maximum(energy @ self._at_checks, np.finfo(float).tiny)
        self._best_prior = np.max(self._prior, axis=1)

    def phases(self, n: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """Draw points and signals; yield arrays (position, posterior variance, squared error)."""
        model = self._model
        # Systematic sampling spreads the points evenly over the region.
        shares = np.cumsum(np.exp(self._prior - self._prior.max()))
        chosen = np.searchsorted(shares / shares[-1], (np.arange(n) + rng.uniform()) / n)
        rays, ranges = np.divmod(np.minimum(chosen, shares.size - 1), self._prior.shape[1])
        truth = self._sight[rays] * self._ranges[ranges, None]
        signals = model.whiten(model.mean(truth))
        noise = rng.standard_normal((2, *signals.shape)) / np.sqrt(2)
        signals += noise[0] + 1j * noise[1]
        for block in blocks(n, _BLOCK):
            for products, ray, index in zip(
                    self._products(signals[block]), rays[block], ranges[block], strict=True):
                yield self._moments(products, ray, index)

    def _products(self, signals: np.ndarray) -> np.ndarray:
        """Return products of signals and smooth means at the nodes, [n, rays, bands, nodes]."""
        products = np.stack([
            np.matmul(np.conj(signals[:, band]), smooth).reshape(
                len(signals), len(self._offset), -1)
            for band, smooth in enumerate(self._smooth)], axis=2)
        return np.ascontiguousarray(products, np.complex64)

    def _moments(self, products: np.ndarray, ray: int, index: int) -> np.ndarray:
        parts = products.view(np.float32).reshape(len(products), -1)
        least = parts[ray] @ self._basis[:, index] + self._offset[ray, index] - _MARGIN
        # 2 a / r - b / r^2 is at most a^2 / b; a and b vary slowly with the range.
        envelope = np.abs(products @ self._at_checks).sum(axis=1)**2 / self._energy
        likely = envelope.max(axis=1) + self._best_prior > least
        likely[ray] = True
        (rays,) = np.nonzero(likely)
        values = parts[rays] @ self._basis + self._offset[rays]
        chosen, at = np.nonzero(values > least)
        weights, _ = mixture_weights(values[chosen, at].astype(float))
        truth = self._sight[ray] * self._ranges[index]
        places = self._sight[rays[chosen]] * self._ranges[at, None]
        offsets = (places - truth) * self._extends
        mean = weights @ offsets
        return np.array([
            *truth, weights @ np.sum((offsets - mean)**2, axis=1), mean @ mean])


def _steps(model: MeasurementModel, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return lattice steps in (r [m], u, v) from local standard deviations, and the coarseness."""
    positions = model.scenario.sample_positions(256, rng)
    slopes = jacobian(to_polar(positions))
    information = fisher_information(model, positions)
    diagonal = np.einsum('nap,nab,nbp->np', slopes, information, slopes).mean(axis=0)
    low, high = polar_bounds(model.scenario.roi_bounds_m)
    extent = high - low
    steps = np.minimum(
        _STEPS / np.sqrt(np.maximum(diagonal, 1e-30)),
        np.where(extent > 0, extent / _MIN_STEPS, np.inf))
    n_points = np.prod(np.maximum(extent / steps, 1.0))
    coarseness = float(max(n_points / _MAX_POINTS, 1.0))**(1 / 3)
    return steps * coarseness, coarseness
