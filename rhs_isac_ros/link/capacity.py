"""Capacity of the transmission phase at known positions and over a posterior."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.link.band_link import band_index
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import direct_gain, los_sums
from rhs_isac_ros.model.multipath import spatial_covariance
from rhs_isac_ros.model.scenario import check_shape
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.support.threads import one_blas_thread

# Quadrature nodes along each principal axis of the covariance.
_N_NODES = 3
# Upper limit of a standard deviation [m]: it keeps squared distances finite.
_MAX_SPREAD_M = 1e6


@dataclasses.dataclass(frozen=True, eq=False)
class Beam:
    """Beamforming of one band in the transmission phase.

    Attributes
    ----------
    analog
        Configuration c-hat, float64 [N_E], each entry in [0, 1].
    digital
        Digital beamforming vectors s-hat, complex128 [N_SB, K] [sqrt(W)].
    band
        Index of the band, from 0.
    """

    analog: np.ndarray
    digital: np.ndarray
    band: int = 0


@one_blas_thread
def capacity(scenario: Scenario, beam: Beam, positions: np.ndarray) -> np.ndarray:
    """Implements Eq. (10). Capacity R_i of a beam at `positions`, float64 [N, 3] [m].

    The result is float64 [N] [bit/s].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or the beam does not fit the scenario.
    """
    (rates,) = capacities(scenario, [beam], positions)
    return np.asarray(rates)


def capacities(scenario: Scenario, beams: Sequence[Beam], positions: np.ndarray) -> np.ndarray:
    """Compute `capacity` for several beams, float64 [n, N] [bit/s]; errors are the same."""
    bands = [beam.band for beam in beams]
    radiation = np.stack([_radiation(scenario, beam) for beam in beams])
    direct = np.abs(los_sums(scenario, positions, bands, radiation))**2
    through = spatial_covariance(scenario)[band_index(bands)].scatter(radiation)
    scattered = np.sum((through * np.conj(radiation)).real, axis=-1)[:, None]
    snr = (direct + scattered) / scenario.noise_power_w
    return scenario.subband_width_hz * np.log2(1 + snr).sum(axis=-1)


@one_blas_thread
def actual_capacity(scenario: Scenario, beam: Beam, positions: np.ndarray,
                    blocked: np.ndarray | None = None) -> np.ndarray:
    """Compute the capacity on the paths of a channel file; without one, that of `capacity`.

    Takes positions, float64 [N, 3] [m], and which users are blocked, bool [N], if there is a
    channel file; returns float64 [N] [bit/s]. Errors are the same.
    """
    if not scenario.channel:
        return capacity(scenario, beam, positions)
    gains = direct_gain(scenario, positions, beam.band, blocked)
    signals = np.einsum('njm,jm->nj', gains, _radiation(scenario, beam))
    snr = np.abs(signals)**2 / scenario.noise_power_w
    return scenario.subband_width_hz * np.log2(1 + snr).sum(axis=1)


@one_blas_thread
def expected_capacity(
        scenario: Scenario, beam: Beam, mean: np.ndarray, covariance: np.ndarray) -> float:
    """Average Eq. (10) [bit/s] over a Gaussian posterior of the user's position.

    The posterior has a mean, float64 [3] [m], and a covariance, float64 [3, 3] [m^2].

    Raises
    ------
    ValueError
        If `mean` or `covariance` has a wrong shape or is not finite, or the beam does not fit the
        scenario.
    """
    return float(expected_capacities(scenario, [beam], mean, covariance)[0])


def expected_capacities(
        scenario: Scenario, beams: Sequence[Beam], mean: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Compute `expected_capacity` for several beams, float64 [n] [bit/s]; errors are the same."""
    points, weights = posterior_points(scenario, mean, covariance)
    # One product for each beam, so that the others do not affect its rounding.
    return np.array([weights @ rates for rates in capacities(scenario, beams, points)])


def direct_power_w(scenario: Scenario, beam: Beam, positions: np.ndarray) -> np.ndarray:
    """Compute the power of the line-of-sight term of Eq. (10) at positions, float64 [N, 3] [m].

    The result is the sum over the sub-bands, float64 [N] [W]. Errors are those of `capacity`.
    """
    (sums,) = los_sums(scenario, positions, [beam.band], _radiation(scenario, beam)[None])
    return np.sum(np.abs(sums)**2, axis=1)


def posterior_points(
        scenario: Scenario, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the nodes and weights of a quadrature over a Gaussian posterior.

    The quadrature is deterministic: a product of Gauss-Hermite rules along the principal axes of
    the covariance, exact for polynomials up to the fifth degree in each axis. All weights are
    positive, so that an average of capacities lies between the smallest and the largest of them.
    An axis without variance has one node. Nodes closer to the surface than both the region of
    interest and the mean are moved out to the closer of the two. Otherwise, a tail of the
    Gaussian at or behind the surface would contribute capacities that cannot occur.

    Parameters
    ----------
    mean
        Float64 [3] [m].
    covariance
        Float64 [3, 3] [m^2]. Only its symmetric part is used; negative variances count as 0.

    Returns
    -------
    tuple of numpy.ndarray
        Positions, float64 [n, 3] [m], and weights with the sum 1, float64 [n].

    Raises
    ------
    ValueError
        If `mean` or `covariance` has a wrong shape or is not finite.
    """
    for name, value, shape in (('mean', mean, (3,)), ('covariance', covariance, (3, 3))):
        if np.shape(value) != shape or not np.isfinite(value).all():
            raise ValueError(f'{name}: {value}, expected {list(shape)} finite numbers')
    # Halve before adding: the sum of two numbers near the largest float is infinite.
    variances, axes = np.linalg.eigh(np.divide(covariance, 2) + np.divide(covariance, 2).T)
    spreads = np.minimum(np.sqrt(np.maximum(variances, 0)), _MAX_SPREAD_M)
    nodes, weights = _standard_rule(tuple(bool(spread > 0) for spread in spreads))
    points = mean + nodes * spreads @ axes.T
    points[:, 0] = np.maximum(points[:, 0], min(mean[0], scenario.roi_bounds_m[0][0]))
    return points, weights


@functools.lru_cache(maxsize=8)
def _standard_rule(varies: tuple[bool, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [n, 3] and weights [n] for a Gaussian with unit variance in the axes that vary."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(_N_NODES)
    weights = weights / weights.sum()
    rule = list(zip(nodes, weights, strict=True))
    axes = [rule if axis_varies else [(0.0, 1.0)] for axis_varies in varies]
    product = np.array(list(itertools.product(*axes)))
    return product[..., 0], product[..., 1].prod(axis=1)


def _radiation(scenario: Scenario, beam: Beam) -> np.ndarray:
    """Radiation t_j = c . (s_j B_j) of the elements, complex128 [N_SB, N_E]."""
    check_shape('analog', beam.analog, 'N_E', scenario)
    check_shape('digital', beam.digital, 'N_SB K', scenario)
    if not 0 <= beam.band < scenario.n_bands:
        raise ValueError(f'band: {beam.band}, expected 0 to {scenario.n_bands - 1}')
    feeds: np.ndarray = np.einsum('jk,jkm->jm', beam.digital, onboard_matrix(scenario)[beam.band])
    return feeds * beam.analog


class RunningQuartiles:
    """Quartiles of the newest rows of values, exact over a bounded window.

    The window bounds memory and time, and lets the quartiles follow a changing network.
    A row has `n_values` values; rows older than the last `window` are discarded.

    Raises
    ------
    ValueError
        If a size is not positive.
    """

    def __init__(self, n_values: int, window: int = 1000) -> None:
        if n_values < 1 or window < 1:
            raise ValueError(f'n_values, window: {n_values}, {window}, expected at least 1 each')
        self._rows = np.empty((window, n_values))
        self._n_added = 0

    def __len__(self) -> int:
        """Return the number of rows in the window."""
        return min(self._n_added, len(self._rows))

    def add(self, row: np.ndarray) -> None:
        """Add a row, float64 [n_values]; it replaces the oldest one if the window is full.

        Raises
        ------
        ValueError
            If the row has another shape or is not finite.
        """
        row = np.asarray(row, dtype=float)
        if row.shape != self._rows.shape[1:] or not np.isfinite(row).all():
            raise ValueError(f'row: {row}, expected {self._rows.shape[1]} finite values')
        self._rows[self._n_added % len(self._rows)] = row
        self._n_added += 1

    def quartiles(self) -> np.ndarray:
        """Return lower quartile, median and upper quartile of each value, float64 [n_values, 3].

        Quartiles between two rows are interpolated linearly.

        Raises
        ------
        ValueError
            If no row has been added yet.
        """
        if not len(self):
            raise ValueError('quartiles: no rows, expected at least one')
        return np.quantile(self._rows[:len(self)], (0.25, 0.5, 0.75), axis=0).T
