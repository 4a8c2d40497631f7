"""Multipath: spatial covariance, correlation over sub-bands and frames, and random gains.

Indices of bands, sub-bands and frames start at 0. Bands are independent. Fields of the scenario
declare the covariance of the gains; a measured covariance adds a term of low rank (see `hall`).
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import geometry
from rhs_isac_ros.model.arrays import adjoint, blocks, gauss_legendre, read_only
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.hall import MultipathEstimate
from rhs_isac_ros.model.scenario import Scenario

# Gauss-Legendre nodes in each interval of angles, of integrals and of random plane waves, and the
# largest change of phase over the surface that a node resolves.
_ANGLE_NODES, _WAVE_NODES = 64, 160
_PHASE_PER_NODE_RAD = 2.0
# Number of elements above which products with V_i are computed as convolutions.
_MAX_MATRIX = 1024
# Target number of complex numbers to process at a time.
_BLOCK_NUMBERS = 1 << 22
# Quadrature nodes along each side of the region of interest; few suffice, as 1 / r^2 is smooth.
_ROI_NODES = 24
# Share of the largest eigenvalue of a covariance below which drawn multipath lacks eigenvectors.
_DRAWN = 1e-10


def multipath_covariance(scenario: Scenario) -> np.ndarray:
    """Implements Eq. (2). Covariance of the multipath gains, without the term of a survey.

    The power-angle profile is a product of two Laplacians with the spread `angular_spread_deg`,
    centred on `multipath_direction_deg`. Its total over the half space in front of the surface is
    the result of `mean_los_power`, raised by ``multipath_to_los_db``; the paper leaves this scale
    open. The power gain of the elements then weights the profile. Returns V_i, complex128
    [N_B, N_E, N_E], read-only; for many elements, `declared_covariance` needs less memory.
    """
    if scenario.element_positions_m is not None:
        return _of_positions(scenario)
    return _matrix(_lattice(scenario), scenario)


@dataclasses.dataclass(frozen=True, eq=False)
class SpatialCovariance:
    """V_i of Eq. (2), stored for fast products, for one band or for several on a leading axis.

    The declared covariance of two elements depends only on their offset on the lattice, so a
    product with it is a convolution. For few elements, a matrix is as fast. A survey adds a
    low-rank term to the declared covariance.
    """

    shape: tuple[int, int]  #: Numbers of rows and columns of the elements.
    is_real: bool  #: Whether V_i is real, as for an even profile without a measured term.
    power: np.ndarray  #: Power of the gain of each element, float64 [N_E] or [N_B, N_E].
    matrix: np.ndarray | None = None  #: V_i [..., N_E, N_E]; None for many elements.
    # Fourier transform of V_i over the offsets of the elements; None for few elements.
    spectrum: np.ndarray | None = None
    # W F and F of the low-rank term that `plus` adds, if there is no matrix.
    excess: tuple[np.ndarray, np.ndarray] | None = None

    def __getitem__(self, bands: int | slice | list[int]) -> 'SpatialCovariance':
        """Return V_i of one or more of the bands."""
        return SpatialCovariance(
            self.shape, self.is_real, self.power[bands],
            None if self.matrix is None else self.matrix[bands],
            None if self.spectrum is None else self.spectrum[bands],
            self.excess and (self.excess[0][bands], self.excess[1][bands]))

    def plus(self, weights: np.ndarray, factor: np.ndarray) -> 'SpatialCovariance':
        """Return V_i + F^H W F, for Hermitian W [N_B, R, R] and F [N_B, R, N_E]."""
        through = np.matmul(weights, factor)
        power = self.power + np.sum(np.conj(factor) * through, axis=-2).real
        total = dataclasses.replace(self, is_real=False, power=power)
        if self.matrix is None:
            return dataclasses.replace(total, excess=(through, factor))
        return dataclasses.replace(
            total, matrix=read_only(self.matrix + np.matmul(adjoint(factor), through)))

    def scatter(self, weights: np.ndarray) -> np.ndarray:
        """Map weights w, complex128 [..., N_E] or [N_B, ..., N_E], to w V_i of the same shape."""
        rows = weights.reshape(*self.power.shape[:-1], -1, weights.shape[-1])
        result = np.empty(rows.shape, complex)
        if self.matrix is None:
            self._convolve(rows, result)
        elif not self.is_real:
            np.matmul(rows, self.matrix, out=result)
        else:
            # A real product takes half the time of a complex one.
            parts = np.concatenate([rows.real, rows.imag], axis=-2) @ self.matrix
            n_rows = rows.shape[-2]
            result.real, result.imag = parts[..., :n_rows, :], parts[..., n_rows:, :]
        return result.reshape(weights.shape)

    def _convolve(self, rows: np.ndarray, result: np.ndarray) -> None:
        from scipy import fft

        assert self.spectrum is not None
        lattice = rows.reshape(*rows.shape[:-1], *self.shape)
        (n_rows, n_columns), sizes = self.shape, self.spectrum.shape[-2:]
        for part in blocks(rows.shape[-2], max(_BLOCK_NUMBERS // math.prod(sizes), 1)):
            waves = fft.fft2(lattice[..., part, :, :], sizes)
            waves *= self.spectrum[..., None, :, :]
            found = fft.ifft2(waves, overwrite_x=True)[..., :n_rows, :n_columns]
            result[..., part, :] = found.reshape(result[..., part, :].shape)
        if self.excess:
            through, factor = self.excess
            result += np.matmul(rows @ adjoint(factor), through)


@functools.lru_cache(maxsize=16)
def spatial_covariance(scenario: Scenario) -> SpatialCovariance:
    """Return V_i of all bands; a measured covariance is averaged over the measurements."""
    declared = declared_covariance(scenario)
    if not (measured := scenario.multipath):
        return declared
    correlation = measurement_correlation(scenario)
    weights = measured.excess * np.matmul(
        np.swapaxes(correlation, 1, 2), np.conj(correlation)) / correlation.shape[1]
    return declared.plus(weights, declared.scatter(measured.radiation))


@functools.lru_cache(maxsize=16)
def declared_covariance(scenario: Scenario) -> SpatialCovariance:
    """Return V_i of all bands as the fields declare it; it is the same in all measurements."""
    if scenario.element_positions_m is not None:
        matrix = _of_positions(scenario)
        return SpatialCovariance((1, scenario.n_elements), False, np.diagonal(
            matrix, axis1=1, axis2=2).real.copy(), matrix)
    lattice, shape = _lattice(scenario), (scenario.n_rows, scenario.n_columns)
    is_real = not lattice.imag.any()
    power = np.repeat(lattice[:, shape[0] - 1, shape[1] - 1, None].real, scenario.n_elements, 1)
    if scenario.n_elements <= _MAX_MATRIX:
        matrix = _matrix(lattice.real if is_real else lattice, scenario)
        return SpatialCovariance(shape, is_real, power, matrix)
    from scipy import fft

    # Padding keeps the circular convolution from wrapping around; the offset 0 comes first.
    kernel = np.zeros((len(lattice), *(fft.next_fast_len(2 * n - 1) for n in shape)), complex)
    kernel[:, :2 * shape[0] - 1, :2 * shape[1] - 1] = np.conj(lattice)
    kernel = np.roll(kernel, (1 - shape[0], 1 - shape[1]), axis=(1, 2))
    return SpatialCovariance(shape, is_real, power, spectrum=fft.fft2(kernel).real)


def _matrix(lattice: np.ndarray, scenario: Scenario) -> np.ndarray:
    row, column = np.divmod(np.arange(scenario.n_elements), scenario.n_columns)
    return read_only(lattice[:, row[:, None] - row + scenario.n_rows - 1,
                             column[:, None] - column + scenario.n_columns - 1])


@functools.lru_cache(maxsize=16)
def _lattice(scenario: Scenario) -> np.ndarray:
    """Compute V_i by lattice offset, [N_B, 2 rows - 1, 2 columns - 1]; offset 0 is central."""
    is_even = [not angle for angle in scenario.multipath_direction_deg]
    lattice = np.empty((scenario.n_bands, 2 * scenario.n_rows - 1, 2 * scenario.n_columns - 1),
                       complex)
    for band in range(scenario.n_bands):
        total = np.zeros((1, 1, 1))
        for waves in _plane_waves(scenario, band, is_even, _ANGLE_NODES):
            shares = waves.azimuth_weights * np.square(waves.gain)
            along_y = np.einsum('yea,ea->ey', waves.along_y, np.broadcast_to(
                shares, waves.along_y.shape[1:]))
            # Offsets of both signs along z, but only non-negative ones along y.
            along_z = [waves.along_z]
            if not is_even[1]:
                along_z.append(np.conj(waves.along_z))
            total = total + np.stack([
                (one * waves.elevation_weights) @ along_y for one in along_z])
        half = np.concatenate([total[-1][:0:-1], total[0]])
        half = half * _mean_power(scenario, band)
        lattice[band] = np.concatenate([np.conj(half[::-1, :0:-1]), half], axis=1)
    return lattice


@functools.lru_cache(maxsize=16)
def _of_positions(scenario: Scenario) -> np.ndarray:
    """Compute V_i for elements at any positions, complex128 [N_B, N_E, N_E], read-only."""
    elements = geometry.element_positions(scenario)
    # Elements that face along one axis have equal gains.
    facing = geometry.element_normals(scenario)[:1 if scenario.element_normals is None else None]
    matrices = np.zeros((scenario.n_bands, len(elements), len(elements)), complex)
    extent_m = np.linalg.norm(np.ptp(elements, axis=0))
    for band, matrix in enumerate(matrices):
        wavenumber = 2 * np.pi * scenario.center_frequencies_hz[band] / SPEED_OF_LIGHT_MPS
        (azimuth, azimuth_weights), (elevations, elevation_weights) = (
            _profile_quadrature(scenario.angular_spread_deg, mean, False, wavenumber * extent_m,
                                _ANGLE_NODES) for mean in scenario.multipath_direction_deg)
        for elevation, weight in zip(elevations, elevation_weights, strict=True):
            directions = np.stack([
                np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                np.full(len(azimuth), np.sin(elevation))], axis=1)
            amplitudes = np.sqrt(weight * azimuth_weights)[:, None] * _element_gain(
                scenario, np.clip(directions @ facing.T, -1, 1))
            waves = amplitudes * np.exp(1j * wavenumber * directions @ elements.T)
            matrix += waves.T @ np.conj(waves)
        matrix *= _mean_power(scenario, band)
    return read_only(matrices)


def _element_gain(scenario: Scenario, cosine: np.ndarray) -> np.ndarray:
    """Return the gain of an element for cosines of the angle from the boresight."""
    if isinstance(scenario.element_gain, GainPattern):
        return scenario.element_gain.amplitude(np.arccos(cosine))
    return np.full(cosine.shape, scenario.element_gain)


class _PlaneWaves(NamedTuple):
    """Plane waves from E elevations and A azimuths."""

    # Shares of the power [E] and [A], and gain of an element, [E, A] or [1, 1].
    elevation_weights: np.ndarray
    azimuth_weights: np.ndarray
    gain: float | np.ndarray
    # Phasors at the rows [rows, E] and at the columns [columns, E, A]; only their real parts along
    # an axis that `is_even` marks.
    along_z: np.ndarray
    along_y: np.ndarray


def _plane_waves(
        scenario: Scenario, band: int, is_even: Sequence[bool], n_nodes: int, n_draws: int = 1
) -> Iterator[_PlaneWaves]:
    """Yield plane waves in blocks of elevations, sized for `n_draws` amplitudes per wave."""
    wavenumber = 2 * np.pi * scenario.center_frequencies_hz[band] / SPEED_OF_LIGHT_MPS
    counts = scenario.n_columns, scenario.n_rows
    by_column, by_row = (
        wavenumber * interval_m for interval_m in geometry.element_intervals_m(scenario))
    phases = by_column * (counts[0] - 1), by_row * (counts[1] - 1)
    # The elevation affects the phases along both axes.
    ranges = phases[0], math.hypot(*phases)
    (azimuth, azimuth_weights), (elevations, elevation_weights) = (
        _profile_quadrature(
            _fields(scenario).angular_spread_deg, mean, even, phase, n_nodes)
        for mean, even, phase in zip(
            scenario.multipath_direction_deg, is_even, ranges, strict=True))
    size = max(_BLOCK_NUMBERS // (len(azimuth) * max(counts[0], n_draws)), 1)
    for block in blocks(len(elevations), size):
        elevation = elevations[block]
        # Direction (cos el cos az, cos el sin az, sin el).
        across = np.cos(elevation)[:, None] * np.sin(azimuth)
        # The cosine of the angle from the boresight is cos el cos az.
        cosine = np.cos(elevation)[:, None] * np.cos(azimuth)
        gain = _element_gain(scenario, cosine if isinstance(
            scenario.element_gain, GainPattern) else cosine[:1, :1])
        yield _PlaneWaves(
            elevation_weights[block], azimuth_weights, gain,
            _phasors(by_row * np.sin(elevation), counts[1], is_even[1]),
            _phasors(by_column * across, counts[0], is_even[0]))


def _phasors(phase: np.ndarray, n: int, is_even: bool) -> np.ndarray:
    """Return exp(i k phase) for k < n, [n, ...]; only the real part of an even profile."""
    powers = np.ones((n, *phase.shape), complex)
    # Products of known powers, which are several times as fast as exponentials.
    step, known = np.exp(1j * phase), 1
    while known < n:
        more = min(known, n - known)
        np.multiply(powers[:more], step, out=powers[known:known + more])
        step, known = step * step, 2 * known
    return np.ascontiguousarray(powers.real) if is_even else powers


def _mean_power(scenario: Scenario, band: int) -> float:
    level_db = _fields(scenario).multipath_to_los_db
    return mean_los_power(scenario, band) * float(10 ** (level_db / 10))


def mean_los_power(scenario: Scenario, band: int) -> float:
    """Compute the mean line-of-sight power gain in the region of interest, for g^E = 1.

    This is the mean of (v_0 g^U / (4 pi f_c,i r))^2, where r is the distance from the centre of
    the surface. A gain pattern g^U is evaluated at the angle seen from this centre.
    """
    gain, pattern = scenario.user_gain, None
    if isinstance(gain, GainPattern):
        gain, pattern = 1.0, gain
    low, high = scenario.roi_bounds_m.tolist()
    mean_inverse = _mean_inverse_square(tuple(low), tuple(high), pattern)
    wavelength = SPEED_OF_LIGHT_MPS / scenario.center_frequencies_hz[band]
    return float((wavelength * gain / (4 * np.pi))**2 * mean_inverse)


@functools.lru_cache(maxsize=16)
def _mean_inverse_square(
        low: tuple[float, ...], high: tuple[float, ...], pattern: GainPattern | None) -> float:
    """Return the mean of (g^U / r)^2 between two corners of a region; g^U is 1 without a pattern.

    Scenarios of a survey differ in the fields of the multipath, but not in their regions.
    """
    nodes, weights = gauss_legendre(_ROI_NODES)
    corners = np.array([low, high])
    x, y, z = (corners.mean(axis=0) + nodes[:, None] * np.ptp(corners, axis=0) / 2).T
    squares = x[:, None, None]**2 + y[:, None]**2 + z**2
    inverse = 1 / squares
    if pattern:
        inverse *= pattern.amplitude(np.arccos(x[:, None, None] / np.sqrt(squares)))**2
    return float(np.einsum('a,b,c,abc->', weights, weights, weights, inverse) / 8)


def frequency_correlation(scenario: Scenario, difference_hz: np.ndarray) -> np.ndarray:
    """Implements Eq. (3). Correlation rho_f of sub-bands of a band, complex128.

    Takes differences between their frequencies [Hz], of any shape.
    """
    return 1 / (1 + 2j * np.pi * _fields(scenario).delay_spread_s * difference_hz)


def time_correlation(scenario: Scenario, lag_s: float | np.ndarray) -> np.ndarray:
    """Implements Eq. (4). Correlation rho_t of frames that are `lag_s` [s] apart.

    Returns float64 [N_B, ...] for lags of any shape.
    """
    centers_hz = np.array(scenario.center_frequencies_hz)
    doppler_hz = scenario.max_user_speed_mps * centers_hz / SPEED_OF_LIGHT_MPS
    # Every node imports this module, and SciPy takes longer to load than ROS.
    from scipy.special import j0

    return j0(2 * np.pi * np.multiply.outer(doppler_hz, lag_s))


@functools.lru_cache(maxsize=16)
def measurement_correlation(scenario: Scenario) -> np.ndarray:
    """Implements Eq. (15). Correlation of the multipath over all measurements of a band.

    Returns the Kronecker products of K_f and K_t, complex128 [N_B, N_SB F, N_SB F]. Rows and
    columns are sub-band-major; the array is read-only.
    """
    subbands, frames = np.arange(scenario.n_subbands), np.arange(scenario.n_frames)
    over_frequency = frequency_correlation(
        scenario, (subbands[:, None] - subbands) * scenario.spacing_hz)
    over_time = time_correlation(scenario, geometry.frame_lags_s(scenario))[
        :, np.abs(frames[:, None] - frames)]
    return read_only(np.kron(over_frequency, over_time))


def coupling(scenario: Scenario, radiation: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Compute the declared cross-covariance of multipath received with two radiation matrices.

    Returns complex128 [N_B, N_SB F, N_SB F] [W] for matrices T_i, complex128 [N_B, N_SB F, N_E].
    """
    scattered = np.matmul(declared_covariance(scenario).scatter(radiation), adjoint(other))
    return measurement_correlation(scenario) * scattered


def scattered_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Compute the part of `signal_covariance` that is due to multipath."""
    covariance = coupling(scenario, radiation, radiation)
    if measured := scenario.multipath:
        to_survey = coupling(scenario, radiation, measured.radiation)
        covariance += np.matmul(to_survey @ measured.excess, adjoint(to_survey))
    return covariance


@functools.lru_cache(maxsize=16)
def multipath_factors(scenario: Scenario) -> tuple[tuple[np.ndarray | None, np.ndarray], ...]:
    """Compute the factors with which `draw_multipath` correlates the gains.

    For each band, these are G [N_E, r] with G G^H = V_i as declared, or None for many elements,
    and L [N_SB F, s] with L L^H = K_ft; see `drawing_root`.
    """
    has_matrix = declared_covariance(scenario).matrix is not None
    matrices = multipath_covariance(scenario) if has_matrix else [None] * scenario.n_bands
    return tuple(
        (None if spatial is None else drawing_root(spatial), drawing_root(correlation))
        for spatial, correlation in zip(
            matrices, measurement_correlation(scenario), strict=True))


def draw_multipath(
        scenario: Scenario, band: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw multipath gains h^MP of a band in n positioning phases, complex128 [n, N_SB F, N_E]."""
    spatial, over_rows = multipath_factors(scenario)[band]
    n_draws = over_rows.shape[1]
    if spatial is None:
        drawn = _draw_plane_waves(scenario, band, n * n_draws, rng).reshape(n, n_draws, -1)
    else:
        drawn = complex_normal((n, n_draws, spatial.shape[1]), rng) @ spatial.T
    gains = over_rows @ drawn
    if measured := scenario.multipath:
        stretch, factor = _stretches(scenario)[band]
        signals = np.sum(gains * measured.radiation[band], axis=-1) @ stretch.T
        gains += (measurement_correlation(scenario)[band] * signals[:, None]) @ np.conj(factor)
    return gains


def _draw_plane_waves(
        scenario: Scenario, band: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw n vectors of gains as sums of independent plane waves, without a factor of V_i."""
    drawn = np.zeros((1, 1, 1))
    for waves in _plane_waves(scenario, band, (False, False), _WAVE_NODES, n):
        amplitudes = complex_normal(
            (len(waves.elevation_weights), n, len(waves.azimuth_weights)), rng)
        amplitudes *= (waves.gain * np.sqrt(
            waves.elevation_weights[:, None] * waves.azimuth_weights))[:, None]
        drawn = drawn + np.einsum(
            'ze,eny->nzy', waves.along_z,
            np.matmul(amplitudes, np.moveaxis(waves.along_y, 0, 2)), optimize=True)
    return np.sqrt(_mean_power(scenario, band)) * drawn


@functools.lru_cache(maxsize=16)
def _stretches(scenario: Scenario) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Compute A and T V_i of each band; g + C_0 T^H A T g then has the measured covariance.

    Here, g are gains with the declared covariance C_0, and the signals T g have a covariance
    R R^H. The covariance in `hall` then requires R^H A R = (1 + R^H M R)^(1/2) - 1.
    """
    assert scenario.multipath
    radiation, stretches = scenario.multipath.radiation, []
    for declared, excess, factor in zip(
            coupling(scenario, radiation, radiation), scenario.multipath.excess,
            declared_covariance(scenario).scatter(radiation), strict=True):
        root = square_root(declared)
        values, vectors = np.linalg.eigh(np.conj(root.T) @ excess @ root)
        growth = np.sqrt(np.maximum(1 + values, 0.0)) - 1
        # Columns of the root are orthogonal.
        inverse = root / np.sum(np.abs(root)**2, axis=0)
        whitened = inverse @ vectors
        stretches.append((whitened * growth @ np.conj(whitened.T), factor))
    return tuple(stretches)


def complex_normal(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw circularly symmetric complex normal numbers of unit variance, complex128."""
    return rng.standard_normal((*shape, 2)).view(complex)[..., 0] * np.sqrt(0.5)


def _fields(scenario: Scenario) -> Scenario | MultipathEstimate:
    """Return the object whose fields declare V_i: the survey if there is one, or the scenario."""
    return scenario.multipath or scenario


def _profile_quadrature(spread_deg: float, mean_deg: float, is_even: bool, phase: float,
                        n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return angles [rad] and weights of sum 1 for a Laplacian or, if even, its positive half."""
    nodes, weights = gauss_legendre(n_nodes)
    mean, spread = np.deg2rad(mean_deg), np.deg2rad(spread_deg)
    angles, density = [], []
    signs = (1,) if is_even else (-1, 1)
    # Each side of the cusp at the mean ends at 90 degrees, or earlier for a narrow profile.
    reaches = [min(1 - sign * mean / (np.pi / 2), 30 * spread / (np.pi / 2)) for sign in signs]
    for sign, reach in zip(signs, reaches, strict=True):
        panels = math.ceil(phase * reach / (n_nodes * _PHASE_PER_NODE_RAD)) or 1
        for panel in range(panels):
            distance = (nodes + 1 + 2 * panel) * (np.pi / 4) * (reach / panels)
            share = reach / panels / sum(reaches)
            angles.append(mean + sign * distance)
            density.append(share * weights * np.exp(-np.sqrt(2) * distance / spread))
    whole = np.concatenate(density)
    return np.concatenate(angles), whole / whole.sum()


def square_root(matrix: np.ndarray) -> np.ndarray:
    """Return R [n, rank] with R R^H = matrix, without eigenvalues at the level of rounding."""
    values, vectors = np.linalg.eigh(matrix)
    keep = values > values[-1] * len(values) * np.finfo(float).eps
    return read_only(vectors[:, keep] * np.sqrt(values[keep]))


def drawing_root(matrix: np.ndarray) -> np.ndarray:
    """Return R [n, r] with R R^H = matrix, without small eigenvalues, for random numbers.

    Rounding, which differs among processors, determines neither r nor R; see `turned`.
    """
    values, vectors = np.linalg.eigh(matrix)
    keep = values > values[-1] * _DRAWN
    return read_only(turned(vectors[:, keep] * np.sqrt(values[keep])))


def turned(root: np.ndarray) -> np.ndarray:
    """Return R U, complex128 [n, r], which is the same for all R that have the same R R^H.

    Phases of eigenvectors, and vectors of equal eigenvalues, depend on rounding. The unitary U
    brings R as close as possible to constant numbers.
    """
    constant = complex_normal(root.shape, np.random.default_rng(0))
    left, _, right = np.linalg.svd(np.conj(root.T) @ constant, full_matrices=False)
    result: np.ndarray = root @ (left @ right)
    return result
