"""Grids of many sub-bands, combined to the few numbers that depend on the position.

Direct paths from the region arrive within tens of nanoseconds, so their signals change slowly from
sub-band to sub-band, while the multipath decorrelates within a few of them. The optimal weights of
the sub-bands are slow functions of the frequency, too, apart from layers at the edges of the band,
as long as the weights of the codebook are slow. Chebyshev polynomials of a frequency that is
stretched at the edges represent them; the error decreases exponentially with their number.

The combinations E^H y have the mean E^H mu and the covariance E^H Lambda E. Their likelihood is
exact; compared with that of all signals, it lacks about 1e-5 nats or less. The covariance needs no
array of all measurements: T_i is a sum of few products of functions of the sub-band with matrices,
and K_f of Eq. (3) is a Toeplitz matrix.
"""

import functools

import numpy as np

from rhs_isac_ros.model import multipath
from rhs_isac_ros.model.arrays import adjoint, blocks, gauss_legendre, read_only
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.elements import has_errors
from rhs_isac_ros.model.geometry import frame_lags_s, polar_bounds
from rhs_isac_ros.model.scenario import Scenario

# Number of functions of the sub-bands, and further ones per turn of the phase over the band that
# the range of the region causes. With them, less than 1e-6 nats are lost of 256 sub-bands in
# 100 MHz; a third more functions add less than 1e-5 nats to 3276 sub-bands.
_FUNCTIONS, _PER_TURN = 64, 8
# Share of the largest singular value below which terms of T_i are rounding errors, and share of
# T_i that the functions may lack if it changes slowly.
_NEGLIGIBLE, _ROUGH = 1e-12, 1e-3
# Largest delay of drawn multipath, in delay spreads; nodes of its panels, and change of the phase
# over the band from one node to the next [rad].
_REACH, _NODES, _PHASE_PER_NODE_RAD = 28.0, 64, 3.0
# Number of complex numbers to draw at a time.
_BLOCK_NUMBERS = 1 << 22


@functools.lru_cache(maxsize=16)
def subband_functions(scenario: Scenario) -> np.ndarray | None:
    """Return orthonormal functions of the sub-bands, complex128 [N_SB, D], read-only.

    Returns None if there are not many sub-bands, or the covariance is not that of declared
    multipath and noise.
    """
    (nearest_m, *_), (farthest_m, *_) = polar_bounds(scenario.roi_bounds_m).tolist()
    turns = scenario.bandwidth_hz * (farthest_m - nearest_m) / SPEED_OF_LIGHT_MPS
    n, n_functions = scenario.n_subbands, _FUNCTIONS + int(np.ceil(_PER_TURN * turns))
    if n < 2 * n_functions or has_errors(scenario) or scenario.multipath:
        return None
    offsets = (np.arange(n) - (n - 1) / 2) / n
    # From -1 to 1; near either edge, the spacing of the sub-bands grows in proportion to 1 / n.
    stretched = np.arctanh(2 * offsets / (1 + 2 / n))
    functions = np.polynomial.chebyshev.chebvander(
        stretched / stretched[-1], n_functions - 1) * np.exp(
        -1j * np.pi * scenario.bandwidth_hz * offsets[:, None]
        * (nearest_m + farthest_m) / SPEED_OF_LIGHT_MPS)
    return read_only(np.linalg.qr(functions)[0])


def combine_subbands(functions: np.ndarray | None, signals: np.ndarray) -> np.ndarray:
    """Combine signals [..., N_SB F] to E^H y, [..., D F]; without functions, return them."""
    if functions is None:
        return signals
    by_subband = signals.reshape(*signals.shape[:-1], len(functions), -1)
    return np.matmul(adjoint(functions), by_subband).reshape(*signals.shape[:-1], -1)


def expand_functions(functions: np.ndarray | None, matrices: np.ndarray) -> np.ndarray:
    """Multiply matrices [N_B, D F, n] by E for every frame, complex128 [N_B, N_SB F, n]."""
    if functions is None:
        return matrices
    n_bands, _, n = matrices.shape
    return np.matmul(functions, matrices.reshape(n_bands, functions.shape[1], -1)).reshape(
        n_bands, -1, n)


def is_slow(functions: np.ndarray, radiation: np.ndarray) -> bool:
    """Return whether matrices T_i [N_B, N_SB F, N_E] change slowly with the sub-band."""
    rows = radiation.reshape(len(radiation), len(functions), -1)
    rest = rows - functions @ (adjoint(functions) @ rows)
    return bool(np.linalg.norm(rest) <= _ROUGH * np.linalg.norm(rows))


def combined_covariance(scenario: Scenario, radiation: np.ndarray, functions: np.ndarray
                        ) -> np.ndarray:
    """Compute E^H Lambda_i E for orthonormal functions E, complex128 [N_B, D F, D F] [W]."""
    from scipy.linalg import matmul_toeplitz

    n_functions = functions.shape[1]
    # The first column and the first row of K_f.
    column = multipath.frequency_correlation(
        scenario, np.arange(len(functions)) * scenario.spacing_hz)
    covariance = []
    for band, one in enumerate(radiation):
        over, frames = _terms(scenario, one)
        weighted = (over.conj()[:, :, None] * functions[:, None]).reshape(len(functions), -1)
        products = adjoint(weighted) @ matmul_toeplitz((column, column.conj()), weighted)
        by_frame = _correlated(scenario, band, frames)
        n_terms, n_frames = frames.shape[:2]
        products = products.reshape(n_terms, n_functions, n_terms, n_functions)
        total = np.tensordot(
            np.moveaxis(products, 2, 1).reshape(n_terms**2, -1).T,
            np.moveaxis(by_frame.reshape(n_terms, n_frames, n_terms, n_frames), 2, 1).reshape(
                n_terms**2, -1), axes=1)
        total = total.reshape(n_functions, n_functions, n_frames, n_frames)
        covariance.append(np.moveaxis(total, 2, 1).reshape(n_functions * n_frames, -1))
    noise = scenario.noise_power_w * np.eye(n_functions * n_frames)
    return np.array(covariance) + noise


def scattered_parts(scenario: Scenario, radiation: np.ndarray) -> list[np.ndarray]:
    """Return independent parts of the declared multipath for each T_i, complex128 [N_SB, F, R]."""
    parts = []
    for band, one in enumerate(radiation):
        over, frames = _terms(scenario, one)
        root = multipath.drawing_root(_correlated(scenario, band, frames))
        part = np.tensordot(over, root.reshape(*frames.shape[:2], -1), axes=1)
        # Singular vectors, too, depend on rounding.
        parts.append(multipath.turned(part.reshape(-1, part.shape[2])).reshape(part.shape))
    return parts


def draw_scattered(scenario: Scenario, parts: np.ndarray, n: int, rng: np.random.Generator
                   ) -> np.ndarray:
    """Draw n signals of multipath from its `scattered_parts`, complex128 [n, N_SB F]."""
    factor = _delay_factor(scenario)
    drawn = np.empty((n, *parts.shape[:2]), complex)
    for block in blocks(n, max(_BLOCK_NUMBERS // (factor.shape[1] * parts.shape[2]), 1)):
        shape = factor.shape[1], parts.shape[2], len(drawn[block])
        white = multipath.complex_normal(shape, rng).reshape(shape[0], -1)
        gains = (factor @ white).reshape(-1, *shape[1:])
        drawn[block] = np.moveaxis(np.matmul(parts, gains), 2, 0)
    return drawn.reshape(n, -1)


def _terms(scenario: Scenario, radiation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Separate T_i into functions of the sub-band, [N_SB, L], and matrices, [L, F, N_E]."""
    left, values, right = np.linalg.svd(
        radiation.reshape(scenario.n_subbands, -1), full_matrices=False)
    kept = values > _NEGLIGIBLE * values[0]
    return left[:, kept] * values[kept], right[kept].reshape(
        -1, scenario.n_frames, scenario.n_elements)


def _correlated(scenario: Scenario, band: int, frames: np.ndarray) -> np.ndarray:
    """Compute the covariance of multipath in frames [L, F, N_E], [L F, L F], without K_f."""
    rows = frames.reshape(-1, scenario.n_elements)
    lags_s = frame_lags_s(scenario)
    over_time = multipath.time_correlation(scenario, np.abs(lags_s[:, None] - lags_s))[band]
    spatial = multipath.declared_covariance(scenario)[band].scatter(rows) @ adjoint(rows)
    return np.tile(over_time, (len(frames), len(frames))) * spatial


@functools.lru_cache(maxsize=2)
def _delay_factor(scenario: Scenario) -> np.ndarray:
    """Return G with G G^H = K_f, complex128 [N_SB, R], a sum over delays, read-only.

    The delays have an exponential density, whose transform is Eq. (3).
    """
    nodes, weights = gauss_legendre(_NODES)
    phase = 2 * np.pi * scenario.bandwidth_hz * scenario.delay_spread_s * _REACH
    n_panels = int(np.ceil(phase / (_NODES * _PHASE_PER_NODE_RAD))) or 1
    half = _REACH / n_panels / 2
    delays = (half * (nodes + 1) + 2 * half * np.arange(n_panels)[:, None]).ravel()
    shares = np.tile(half * weights, n_panels) * np.exp(-delays)
    frequencies = np.arange(scenario.n_subbands) * scenario.spacing_hz
    return read_only(np.sqrt(shares) * np.exp(
        -2j * np.pi * scenario.delay_spread_s * np.multiply.outer(frequencies, delays)))
