"""Capacity of a beam at known positions and over a posterior, and the pattern of a beam."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.link.band_link import band_index
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import checked_position, numbers, read_only
from rhs_isac_ros.model.los import direct_gain, los_sums
from rhs_isac_ros.model.multipath import spatial_covariance
from rhs_isac_ros.model.scenario import check_shape
from rhs_isac_ros.model.surface import NOMINAL, Response, ports_of
from rhs_isac_ros.support.fields import finite
from rhs_isac_ros.support.threads import one_blas_thread

# Quadrature nodes along each principal axis of the covariance.
_N_NODES = 3
# Upper limit of a standard deviation [m], to keep squared distances finite.
_MAX_SPREAD_M = 1e6


@dataclasses.dataclass(frozen=True, eq=False)
class Beamformer:
    """Beamforming of one band in the transmission phase."""

    analog: np.ndarray  #: Configuration c-hat, float64 [N_E], each entry in [0, 1].
    digital: np.ndarray  #: Digital beamforming vectors s-hat, complex128 [N_SB, K] [sqrt(W)].
    band: int = 0  #: Index of the band, from 0.
    #: Slope and offset of the elements, and gain of the band, if the surface is known.
    response: Response = NOMINAL


@one_blas_thread
def capacity(scenario: Scenario, beam: Beamformer, positions: np.ndarray) -> np.ndarray:
    """Implements Eq. (10). Capacity R_i of a beam at `positions`, float64 [N, 3] [m].

    The result is float64 [N] [bit/s]. Raises ValueError if `positions` is not a finite [N, 3]
    array, or the beam does not fit the scenario.

    Examples
    --------
    >>> users = np.array([[8.0, 1.0, 0.2], [12.0, -2.0, 0.5]])
    >>> (capacity(Scenario(), steer(Scenario(), users[0]), users) / 1e6).round(1)  # [Mbit/s]
    array([29.4, 27.3])
    """
    return capacities(scenario, [beam], positions)[0]


def capacities(scenario: Scenario, beams: Sequence[Beamformer], positions: np.ndarray,
               blocked: np.ndarray | None = None) -> np.ndarray:
    """Compute `capacity` for several beams, float64 [n, N] [bit/s].

    `blocked`, bool [N], marks users without a direct path.
    """
    bands = [beam.band for beam in beams]
    radiation = np.stack([_radiation(scenario, beam) for beam in beams])
    direct = np.abs(los_sums(scenario, positions, bands, radiation))**2
    if blocked is not None:
        direct[:, blocked] = 0
    through = spatial_covariance(scenario)[band_index(bands)].scatter(radiation)
    scattered = np.sum((through * np.conj(radiation)).real, axis=-1)[:, None]
    return _rate(scenario, direct + scattered)


@one_blas_thread
def actual_capacity(scenario: Scenario, beam: Beamformer, positions: np.ndarray,
                    blocked: np.ndarray | None = None) -> np.ndarray:
    """Compute the capacity over the paths of the channel file, or else by Eq. (10).

    `blocked`, bool [N], marks users without a direct path.
    """
    if not scenario.channel:
        return capacities(scenario, [beam], positions, blocked)[0]
    gains = direct_gain(scenario, positions, beam.band, blocked)
    signals = np.einsum('njm,jm->nj', gains, _radiation(scenario, beam))
    return _rate(scenario, np.abs(signals)**2)


@one_blas_thread
def expected_capacities(
        scenario: Scenario, beams: Sequence[Beamformer], mean: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Average Eq. (10) of n beams over a Gaussian posterior of the position, float64 [n] [bit/s].

    The posterior has the mean, float64 [3] [m], and the covariance, float64 [3, 3] [m^2]. Raises
    ValueError if `mean` or `covariance` has a wrong shape or is not finite, or a beam does not fit
    the scenario.
    """
    points, weights = posterior_points(scenario, mean, covariance)
    # Separate products, so that the number of beams does not affect the rounding.
    return np.array([weights @ rates for rates in capacities(scenario, beams, points)])


def posterior_points(
        scenario: Scenario, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the nodes and weights of a quadrature over a Gaussian posterior.

    The quadrature is a product of Gauss-Hermite rules along the principal axes of the covariance,
    exact for polynomials up to the fifth degree in each axis. An axis without variance has one
    node. All weights are positive, so an average of capacities lies between the smallest and the
    largest of them. A node may be closer to the surface than both the region of interest and the
    mean. It is then moved out to the closer of the two, because a tail of the Gaussian at or
    behind the surface would contribute impossible capacities.

    Only the symmetric part of the covariance is used; negative variances count as 0. Returns
    positions, float64 [n, 3] [m], and weights with the sum 1, float64 [n]. Raises ValueError if
    `mean` or `covariance` has a wrong shape or is not finite.
    """
    mean = checked_position(mean, 'mean')
    covariance = numbers('covariance', covariance, shapes=[(3, 3)])
    # Halve before adding: the sum of two numbers near the largest float is infinite.
    variances, axes = np.linalg.eigh(np.divide(covariance, 2) + np.divide(covariance, 2).T)
    spreads = np.minimum(np.sqrt(np.maximum(variances, 0)), _MAX_SPREAD_M)
    nodes, weights = _standard_rule(tuple(bool(spread > 0) for spread in spreads))
    points = mean + nodes * spreads @ axes.T
    points[:, 0] = np.maximum(points[:, 0], min(mean[0], scenario.roi_bounds_m[0][0]))
    return points, weights


@functools.lru_cache(maxsize=8)
def _standard_rule(varies: tuple[bool, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes [n, 3] and weights [n] for a Gaussian with unit variance along some axes."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(_N_NODES)
    weights = weights / weights.sum()
    rule = list(zip(nodes, weights, strict=True))
    axes = [rule if axis_varies else [(0.0, 1.0)] for axis_varies in varies]
    product = np.array(list(itertools.product(*axes)))
    return product[..., 0], product[..., 1].prod(axis=1)


def _radiation(scenario: Scenario, beam: Beamformer) -> np.ndarray:
    """Return the radiation t_j = c . (s_j B_j) of the elements, complex128 [N_SB, N_E]."""
    analog, digital = numbers('analog', beam.analog), numbers('digital', beam.digital, complex)
    check_shape('analog', analog, 'N_E', scenario)
    check_shape('digital', digital, 'N_SB K', scenario)
    if not 0 <= beam.band < scenario.n_bands:
        raise ValueError(f'band: {beam.band}, expected 0 to {scenario.n_bands - 1}')
    slope, offset, gain = beam.response
    return scenario.board.radiation(
        ports_of(scenario, beam.band), analog[None, None], gain * digital[None, :, None], slope,
        offset)[0, :, 0]


def _rate(scenario: Scenario, power_w: np.ndarray) -> np.ndarray:
    """Sum rates [bit/s] over sub-bands, which are the last axis of the received power [W]."""
    snr = power_w / scenario.noise_power_w
    return scenario.subband_width_hz * np.log2(1 + snr).sum(axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class BeamPattern:
    """Power of a beam over the directions in front of the surface, at one distance."""

    #: Unit vectors from the centre of the surface, float64 [n_el, n_az, 3]; elevation grows along
    #: the first axis, azimuth along the second, both from -90 to 90 degrees.
    directions: np.ndarray
    #: Line-of-sight power relative to the strongest direction, [n_el, n_az]; 0 if the beam is off.
    relative: np.ndarray
    distance_m: float

    def azimuth_cut(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the azimuths [rad], and the power at the elevation of the peak, both [n_az]."""
        row, _ = self.peak
        x, y, _ = self.directions[len(self.directions) // 2].T
        return np.arctan2(y, x), self.relative[row]

    def elevation_cut(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the elevations [rad], and the power at the azimuth of the peak, both [n_el]."""
        _, column = self.peak
        return np.arcsin(self.directions[:, column, 2]), self.relative[:, column]

    @property
    def peak(self) -> tuple[int, int]:
        """Row and column of the strongest direction in `relative`."""
        row, column = np.unravel_index(np.argmax(self.relative), self.relative.shape)
        return int(row), int(column)


@one_blas_thread
def beam_pattern(
        scenario: Scenario, beam: Beamformer, distance_m: float, step_deg: float = 5.0
) -> BeamPattern:
    """Compute the near-field pattern of a beam at a distance from the centre of the surface.

    Neighbouring directions differ by at most `step_deg` in azimuth or in elevation. Raises
    ValueError if the distance or the step is not positive, or the beam does not fit the scenario.
    """
    for name, value in (('distance_m', distance_m), ('step_deg', step_deg)):
        if not finite(name, value) > 0:
            raise ValueError(f'{name}: {value}, expected a positive number')
    directions = _directions(step_deg)
    (sums,) = los_sums(scenario, distance_m * directions.reshape(-1, 3), [beam.band],
                       _radiation(scenario, beam)[None])
    power_w = np.sum(np.abs(sums)**2, axis=1).reshape(directions.shape[:2])
    max_power_w = power_w.max()
    return BeamPattern(directions, power_w / max_power_w if max_power_w else power_w, distance_m)


@functools.lru_cache(maxsize=4)
def _directions(step_deg: float) -> np.ndarray:
    """Return unit vectors over the half space x >= 0, float64 [n_el, n_az, 3], read-only."""
    n_half = max(1, int(np.ceil(90 / step_deg)))
    # An odd number of angles puts the middle one on boresight.
    angles = np.linspace(-np.pi / 2, np.pi / 2, 2 * n_half + 1)
    elevation, azimuth = np.meshgrid(angles, angles, indexing='ij')
    return read_only(np.stack([np.cos(elevation) * np.cos(azimuth),
                               np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1))
