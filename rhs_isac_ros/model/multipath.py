"""Multipath: spatial covariance, correlation over sub-bands and frames, random gains.

Indices of bands, sub-bands and frames start at 0. Bands are independent. Fields of a scenario
declare the covariance of the gains; a measured one adds a term of the rank of its measurements to
it, see `multipath_estimate`.
"""

import functools

import numpy as np

from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.geometry import element_interval_m, subband_frequencies_hz
from rhs_isac_ros.model.multipath_estimate import MultipathEstimate
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario

# Gauss-Legendre nodes on the quarter of the angular domain in which the profile is smooth.
_ANGLE_NODES = 160
# Nodes along each side of the region of interest, where 1 / r^2 is smooth.
_ROI_NODES = 24


@functools.lru_cache(maxsize=16)
def multipath_covariance(scenario: Scenario) -> np.ndarray:
    """Implements Eq. (2). Covariance of the multipath gains of the elements that fields declare.

    The power-angle profile is a product of two Laplacians of `angular_spread_deg`, normalised
    over the half space in front of the surface and scaled by the mean line-of-sight power in the
    region of interest times ``multipath_to_los_db``. The paper leaves the scale open; that both
    powers are equal by default is the reading of this package. The profile is even in azimuth and
    elevation, so the covariance is real. The covariance of two elements depends only on their
    lattice offset. A gain pattern of the elements weights the profile. Returns V_i,
    complex128 [N_B, N_E, N_E], read-only.
    """
    side = scenario.elements_per_side
    azimuth, weights = _profile_quadrature(scenario)
    offsets = np.arange(side) * element_interval_m(scenario)
    row, column = np.divmod(np.arange(side**2), side)
    rows, columns = np.abs(row[:, None] - row), np.abs(column[:, None] - column)
    covariance = np.empty((scenario.n_bands, side**2, side**2), complex)
    for band, frequency in enumerate(scenario.center_frequencies_hz):
        wavenumber = 2 * np.pi * frequency / SPEED_OF_LIGHT_MPS
        # Direction (cos el cos az, cos el sin az, sin el); nodes are shared by both angles.
        across = np.cos(azimuth)[:, None] * np.sin(azimuth)
        along_y = np.cos(wavenumber * across[..., None] * offsets)
        if isinstance(scenario.element_gain, GainPattern):
            # The cosine of the angle from the boresight is cos el cos az.
            angles = np.arccos(np.cos(azimuth)[:, None] * np.cos(azimuth))
            along_y *= scenario.element_gain.amplitude(angles)[..., None]**2
        along_y = np.einsum('a,eay->ey', weights, along_y)
        along_z = np.cos(wavenumber * np.sin(azimuth)[:, None] * offsets)
        lattice = np.einsum('e,ey,ez->zy', weights, along_y, along_z)
        scale = mean_los_power(scenario, band) * 10 ** (_fields(scenario).multipath_to_los_db / 10)
        if not isinstance(scenario.element_gain, GainPattern):
            scale *= scenario.element_gain**2
        covariance[band] = scale * lattice[rows, columns]
    covariance.flags.writeable = False
    return covariance


def mean_los_power(scenario: Scenario, band: int) -> float:
    """Compute the mean line-of-sight power gain in the region of interest, for g^E = 1.

    This is the mean of (v_0 g^U / (4 pi f_c,i r))^2, with the distance r from the surface's
    centre. A gain pattern g^U is evaluated at the angle from the boresight there.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_ROI_NODES)
    low, high = scenario.roi_bounds_m
    x, y, z = ((low + high) / 2 + nodes[:, None] * (high - low) / 2).T
    squares = x[:, None, None]**2 + y[:, None]**2 + z**2
    inverse, gain = 1 / squares, scenario.user_gain
    if isinstance(gain, GainPattern):
        inverse *= gain.amplitude(np.arccos(x[:, None, None] / np.sqrt(squares)))**2
        gain = 1.0
    mean_inverse = np.einsum('a,b,c,abc->', weights, weights, weights, inverse) / 8
    wavelength = SPEED_OF_LIGHT_MPS / scenario.center_frequencies_hz[band]
    return float((wavelength * gain / (4 * np.pi))**2 * mean_inverse)


def frequency_correlation(
        scenario: Scenario, band: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Implements Eq. (3). Correlation rho_f of two sub-bands, complex128; indices broadcast."""
    frequencies = subband_frequencies_hz(scenario)[band]
    difference = frequencies[first] - frequencies[second]
    correlation: np.ndarray = 1 / (1 + 2j * np.pi * _fields(scenario).delay_spread_s * difference)
    return correlation


def time_correlation(
        scenario: Scenario, band: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Implements Eq. (4). Correlation rho_t of two frames, float64; indices broadcast."""
    center_hz = scenario.center_frequencies_hz[band]
    doppler_hz = scenario.max_user_speed_mps * center_hz / SPEED_OF_LIGHT_MPS
    lag_s = (np.asarray(first) - np.asarray(second)) * scenario.frame_duration_s
    # Every node imports this module, and SciPy takes longer to load than ROS.
    from scipy.special import j0

    correlation: np.ndarray = j0(2 * np.pi * doppler_hz * lag_s)
    return correlation


@functools.lru_cache(maxsize=16)
def correlation_matrices(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Implements Eq. (15). Correlation of the multipath over sub-bands and over frames.

    Returns K_f, complex128 [N_B, N_SB, N_SB], and K_t, float64 [N_B, F, F]; read-only.
    """
    subbands, frames = np.arange(scenario.n_subbands), np.arange(scenario.n_frames)
    bands = range(scenario.n_bands)
    over_frequency = np.stack(
        [frequency_correlation(scenario, i, subbands[:, None], subbands) for i in bands])
    over_time = np.stack([time_correlation(scenario, i, frames[:, None], frames) for i in bands])
    over_frequency.flags.writeable = over_time.flags.writeable = False
    return over_frequency, over_time


@functools.lru_cache(maxsize=16)
def measurement_correlation(scenario: Scenario) -> np.ndarray:
    """Compute the correlation K_ft over all measurements, complex128 [N_B, N_SB F, N_SB F].

    Rows and columns are sub-band-major; the array is read-only.
    """
    pairs = zip(*correlation_matrices(scenario), strict=True)
    correlation = np.stack([np.kron(over_f, over_t) for over_f, over_t in pairs])
    correlation.flags.writeable = False
    return correlation


def coupling(scenario: Scenario, radiation: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Compute the declared covariance between signals received with two radiation matrices [W].

    Returns complex128 [N_B, N_SB F, N_SB F] for matrices T_i, complex128 [N_B, N_SB F, N_E].
    """
    scattered = np.matmul(radiation @ multipath_covariance(scenario),
                          np.conj(np.swapaxes(other, 1, 2)))
    covariance: np.ndarray = measurement_correlation(scenario) * scattered
    return covariance


def scattered_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Compute the covariance of the multipath in the received signals, as `signal_covariance`."""
    covariance = coupling(scenario, radiation, radiation)
    if measured := scenario.multipath:
        to_survey = coupling(scenario, radiation, measured.radiation)
        covariance += np.matmul(
            to_survey @ measured.excess, np.conj(np.swapaxes(to_survey, 1, 2)))
    return covariance


@functools.lru_cache(maxsize=16)
def spatial_covariance(scenario: Scenario) -> np.ndarray:
    """Compute the covariance of the gains of the elements, averaged over the measurements.

    Returns complex128 [N_B, N_E, N_E], read-only. A declared covariance is real and the same in
    all measurements.
    """
    declared = multipath_covariance(scenario)
    if not (measured := scenario.multipath):
        return declared
    correlation = measurement_correlation(scenario)
    weights = measured.excess * np.matmul(
        np.swapaxes(correlation, 1, 2), correlation.conj()) / correlation.shape[1]
    across = np.matmul(declared, np.conj(np.swapaxes(measured.radiation, 1, 2)))
    covariance: np.ndarray = declared + np.matmul(
        across @ weights, np.conj(np.swapaxes(across, 1, 2)))
    covariance.flags.writeable = False
    return covariance


@functools.lru_cache(maxsize=16)
def multipath_factors(scenario: Scenario) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Compute the factors with which `draw_multipath` correlates the gains.

    For each band, these are G [N_E, r] with G G^H = V_i, and L [N_SB F, s] with L L^H = K_ft;
    r and s are the numerical ranks.
    """
    pairs = zip(multipath_covariance(scenario), measurement_correlation(scenario), strict=True)
    return tuple((square_root(spatial), square_root(correlation))
                 for spatial, correlation in pairs)


def draw_multipath(
        scenario: Scenario, band: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw multipath gains h^MP of n independent phases, complex128 [n, N_SB F, N_E]."""
    spatial, over_rows = multipath_factors(scenario)[band]
    white = complex_normal((n, over_rows.shape[1], spatial.shape[1]), rng)
    if scenario.multipath:
        basis, stretch = _stretches(scenario)[band]
        flat = white.reshape(n, -1)
        white = white + (flat @ basis.conj() @ stretch.T @ basis.T).reshape(white.shape)
    gains: np.ndarray = over_rows @ (white @ spatial.T)
    return gains


@functools.lru_cache(maxsize=16)
def _stretches(scenario: Scenario) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Compute how a measured covariance changes the white numbers of `draw_multipath`.

    For each band, these are Q with orthonormal columns and D, so that white numbers z become
    z + Q D Q^H z.
    """
    assert scenario.multipath
    stretches = []
    for (spatial, over_rows), radiation, excess in zip(
            multipath_factors(scenario), scenario.multipath.radiation, scenario.multipath.excess,
            strict=True):
        # The signals of the survey are linear in the white numbers.
        signals = (over_rows[:, :, None] * (radiation @ spatial)[:, None]).reshape(
            len(radiation), -1)
        basis, triangle = np.linalg.qr(np.conj(signals.T))
        values, vectors = np.linalg.eigh(triangle @ excess @ np.conj(triangle.T))
        growth = np.sqrt(np.maximum(1 + values, 0.0)) - 1
        stretches.append((basis, vectors * growth @ np.conj(vectors.T)))
    return tuple(stretches)


def complex_normal(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw circularly symmetric complex normal numbers of unit variance, complex128."""
    numbers: np.ndarray = rng.standard_normal((*shape, 2)).view(complex)[..., 0] * np.sqrt(0.5)
    return numbers


def _fields(scenario: Scenario) -> Scenario | MultipathEstimate:
    """Return the owner of the three fields that declare the covariance."""
    return scenario.multipath or scenario


def _profile_quadrature(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Nodes on [0, pi/2] and weights of the Laplacian profile, normalised to a sum of one."""
    nodes, weights = np.polynomial.legendre.leggauss(_ANGLE_NODES)
    angles = (nodes + 1) * np.pi / 4
    spread = np.deg2rad(_fields(scenario).angular_spread_deg)
    # The interval begins at the cusp, zero, and ends earlier for a narrow profile.
    reach = min(1.0, 30 * spread / (np.pi / 2))
    angles = angles * reach
    density = weights * np.exp(-np.sqrt(2) * angles / spread)
    return angles, density / density.sum()


def square_root(matrix: np.ndarray) -> np.ndarray:
    """Return R with R R^H = matrix, without eigenvectors that are due to rounding alone."""
    values, vectors = np.linalg.eigh(matrix)
    keep = values > values[-1] * len(values) * np.finfo(float).eps
    root: np.ndarray = vectors[:, keep] * np.sqrt(values[keep])
    root.flags.writeable = False
    return root
