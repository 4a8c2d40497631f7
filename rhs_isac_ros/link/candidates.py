"""Search for configurations from which the ascent of `steering` starts, in all bands at once.

The coefficient of an element is its slope times its configuration, plus its offset. If there are
offsets, their gains are added up to those of one further element, whose configuration is always 1.
N elements therefore are N_E elements, or N_E + 1.
"""

import functools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.link import band_link
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.multipath import SpatialCovariance, spatial_covariance

# Largest share of the multipath power that the modes may omit, and largest number of modes. The
# ascent that follows includes all of the power.
_MAX_OMITTED, _MAX_MODES = 0.02, 256
# Relative accuracy of the powers of the modes.
_MODE_TOLERANCE = 1e-3
# Largest drift of phases from one sub-band of the search to the next, and largest number of these
# sub-bands.
_MAX_DRIFT_RAD = 1.0
_MAX_SUBBANDS = 16
# Number of random starts, and number that remains after the first step.
_N_STARTS = 256
_N_DIRECT = 64
# Number of steps with the strongest modes of the multipath, number of these modes, and number of
# configurations that are then improved with all modes. Fewer steps would lose the best starts when
# the multipath is as strong as the line of sight; starts for the multipath alone would gain 0.03 %
# when it is ten times as strong.
_N_STEPS = 4
_N_STRONGEST = 4
_N_KEPT = 12
# Configurations whose capacities differ by a smaller share than this count as one.
_MIN_DIFFERENCE = 1e-6
# Limits of the amplitudes relative to the noise.
_AMPLITUDES = (1e-3, 1e4)
# Small number added to norms, to avoid divisions by zero.
_MIN_NORM = 1e-30


class Tables(NamedTuple):
    """The arrays of the search that do not depend on the position, for all bands."""

    subbands: np.ndarray  # Indices of the representative sub-bands, int [J].
    onboard: np.ndarray  # Gains on the board with the slopes, complex64 [N_B, N_E, J, K].
    resting: np.ndarray  # Gains on the board with the offsets, complex64 [N_B, 0 or N_E, J, K].
    # Gains from each feed via each element to each wave in the air, complex64 [N_B, N, J, K, L].
    # The first wave, the line of sight, is zero here. The others are the strongest modes of the
    # multipath, the columns of G with G G^H close to V_i.
    paths: np.ndarray
    starts: np.ndarray  # Waves on the board with which the search starts, float32 [S, 2 J K].
    peaks: np.ndarray  # Upper limits of the amplitude of a mode at a feed, float64 [N_B].
    fixed: np.ndarray  # Elements whose configuration is always 1, bool [N].


def candidate_configurations(
        tables: Tables, link: BandLink, index: slice | list[int], n: int) -> np.ndarray:
    """Find n configurations of high capacity per band, float64 [N_B, n, N_E] of zeros and ones.

    By the holographic principle, a configuration enables the elements at which a wave on the
    board, s B, is in phase with a wave in the air, G w. The waves in the air are the line of sight
    and the modes of the multipath, the columns of G. The search improves waves and configuration
    alternately: the best pair of waves for a configuration belongs to the largest singular value
    of B diag(c) G. It begins with random waves on the board, the same at all positions, and at
    first includes only the line of sight, for which the best wave on the board is known. It then
    adds the matched filter to the best of these. All are improved with the strongest modes of the
    multipath, and the best results with all modes.

    `index` selects the bands of the link from the tables. The configurations of a band are in no
    particular order, and some may be equal.
    """
    los = np.swapaxes(link.los[:, tables.subbands], 1, 2)[..., None]
    resting = tables.resting[index]
    direct = _with_rest(tables.onboard[index] * los, resting * los[:, :resting.shape[1]])
    # The power is divided evenly among the sub-bands. The amplitudes are limited to the range of
    # single precision, which hardly changes the result.
    peak = np.maximum(np.abs(direct).sum(axis=1).max(axis=(1, 2)), tables.peaks[index])
    over_noise = np.sqrt(link.power_w / link.los.shape[1] / link.noise_power_w)
    scale = (np.clip(over_noise * peak, *_AMPLITUDES) / peak)[:, None, None, None]
    direct = (scale * direct).astype(np.complex64, order='C')
    paths = tables.paths[index] * scale[..., None].astype(np.float32)
    paths[..., 0] = direct
    interference = direct.real.sum(axis=(2, 3))[:, None]
    loudest = np.abs(interference[..., ~tables.fixed]).max(axis=-1, keepdims=True) + np.float32(
        _MIN_NORM)
    matched = np.where(tables.fixed, np.float32(1), (interference / loudest + 1) / 2)
    analog = np.concatenate([_direct_configurations(tables, direct), matched], axis=1)
    gains = np.ascontiguousarray(paths[..., :1 + _N_STRONGEST])
    waves = _Waves.at(gains, analog)
    for _ in range(_N_STEPS):
        waves = waves.improved(gains, gains, tables.fixed)
    waves = waves.best(_N_KEPT).improved(gains, paths, tables.fixed)
    return waves.best(n).analog[..., ~tables.fixed].astype(float)


@functools.lru_cache(maxsize=16)
def tables(scenario: Scenario, surface: SurfaceEstimate | None) -> Tables:
    """Compute the tables for a scenario and a calibrated surface, if any."""
    onboard, slope, offset = band_link.arrays(scenario, surface)
    subbands = band_link.representative_subbands(scenario, _MAX_DRIFT_RAD, _MAX_SUBBANDS)
    on_board, resting = (
        np.moveaxis(factor[:, None, None] * onboard[:, subbands], -1, 1)
        for factor in (slope, offset))
    resting = resting[:, :resting.shape[1] * bool(np.any(offset))]
    modes = _modes(scenario)[:, :, None, None]
    gains = _with_rest(*(one[..., None] * modes[:, :one.shape[1]] for one in (on_board, resting)))
    paths = np.zeros((*gains.shape[:-1], 1 + gains.shape[-1]), np.complex64)
    paths[..., 1:] = gains
    fixed = np.arange(len(gains[0])) >= scenario.n_elements
    rng = np.random.default_rng(0)
    n_subbands, n_feeds = len(subbands), scenario.n_feeds
    starts = np.zeros((_N_STARTS, n_subbands, 2 * n_feeds), np.float32)
    # Each start begins with a single sub-band.
    starts[np.arange(_N_STARTS), np.arange(_N_STARTS) % n_subbands] = rng.normal(
        size=(_N_STARTS, 2 * n_feeds))
    peaks = np.abs(paths).sum(axis=1).max(axis=(1, 2, 3)).astype(float) + _MIN_NORM
    return Tables(
        subbands, on_board.astype(np.complex64, order='C'), resting.astype(np.complex64), paths,
        starts.reshape(_N_STARTS, -1), peaks, fixed)


def _with_rest(gains: np.ndarray, resting: np.ndarray) -> np.ndarray:
    """Append the sum of the gains of offsets [N_B, 0 or N_E, ...] to gains [N_B, N_E, ...]."""
    rest = [resting.sum(axis=1, keepdims=True)] * bool(resting.shape[1])
    return np.concatenate([gains, *rest], axis=1)


def _modes(scenario: Scenario, max_modes: int = _MAX_MODES) -> np.ndarray:
    """Return the strongest modes of the multipath, [N_B, N_E, L], padded with zeros."""
    spatial = spatial_covariance(scenario)
    powers, directions = (
        _strongest(spatial, max_modes) if spatial.matrix is None
        else np.linalg.eigh(spatial.matrix))
    powers, directions = np.maximum(powers[:, ::-1], 0), directions[:, :, ::-1]
    omitted = 1 - np.cumsum(powers, axis=1) / np.sum(spatial.power, axis=1, keepdims=True)
    n_modes = 1 + np.sum(omitted > _MAX_OMITTED, axis=1)
    powers[np.arange(powers.shape[1]) >= n_modes[:, None]] = 0
    return (directions * np.sqrt(powers)[:, None])[:, :, :n_modes.max()]


def _strongest(spatial: SpatialCovariance, n_modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest eigenvalues, in ascending order, and their eigenvectors."""
    from scipy.sparse.linalg import LinearOperator, eigsh

    pairs = []
    for band in range(len(spatial.power)):
        def times(vector: np.ndarray, own: SpatialCovariance = spatial[band]) -> np.ndarray:
            # V is Hermitian: V w is the conjugate of conj(w) V.
            product = np.conj(own.scatter(np.conj(vector.ravel())))
            return np.asarray(product.real if own.is_real else product)

        start = np.random.default_rng(0).normal(size=spatial.power.shape[1:])
        start = start.astype(float if spatial.is_real else complex)
        operator = LinearOperator((len(start), len(start)), times, dtype=start.dtype)
        powers, directions = eigsh(operator, n_modes, v0=start, tol=_MODE_TOLERANCE)
        # The eigenvalues of complex matrices are in no particular order.
        order = np.argsort(powers)
        pairs.append((powers[order], directions[:, order]))
    return np.stack([one for one, _ in pairs]), np.stack([other for _, other in pairs])


def _direct_configurations(tables: Tables, direct: np.ndarray) -> np.ndarray:
    """Search for configurations [N_B, n, N] for line-of-sight gains [N_B, N, J, K]."""
    n_bands, n_elements, n_subbands, n_feeds = direct.shape
    # Real arithmetic suffices, because configurations are real and only the real part of the
    # product of the waves matters.
    gains = direct.reshape(n_bands, n_elements, -1).view(np.float32)
    analog = _in_phase(tables.starts @ np.swapaxes(gains, 1, 2), tables.fixed)
    # The best wave on the board is the conjugate of the channels at the feeds.
    received = (analog @ gains).reshape(n_bands, -1, n_subbands, 2 * n_feeds)
    snr = np.einsum('bsjk,bsjk->bsj', received, received)
    rate = np.log1p(snr).sum(axis=-1)
    best = np.argpartition(-rate, _N_DIRECT - 1, axis=1)[:, :_N_DIRECT]
    received /= (1 + snr)[..., None]
    waves = received[np.arange(n_bands)[:, None], best].reshape(n_bands, _N_DIRECT, -1)
    return _in_phase(waves @ np.swapaxes(gains, 1, 2), tables.fixed)


class _Waves(NamedTuple):
    """Configurations, float32 [N_B, n, N], each with its capacity and a pair of waves."""

    analog: np.ndarray
    rate: np.ndarray  # Capacities [nat/symbol], float32 [N_B, n].
    on_board: np.ndarray  # Conjugates of unit waves on the board, complex64 [N_B, n, J, K, 1].
    # Best waves in the air for `on_board`, divided by 1 plus the SNR, complex64 [N_B, n, J, 1, L].
    in_air: np.ndarray

    @classmethod
    def at(cls, paths: np.ndarray, analog: np.ndarray,
           on_board: np.ndarray | None = None) -> '_Waves':
        """Compute waves by a power step from `on_board`; by default, use the direct path."""
        n_bands, n_elements, *shape = paths.shape
        channels = (analog @ paths.reshape(n_bands, n_elements, -1).view(np.float32)).view(
            np.complex64).reshape(n_bands, -1, *shape)
        if on_board is None:
            on_board = channels[..., :1]
        else:
            on_board = channels @ (np.conj(np.swapaxes(channels, -1, -2)) @ on_board)
        on_board = on_board / (np.linalg.norm(on_board, axis=-2, keepdims=True)
                               + np.float32(_MIN_NORM))
        # Faster than a product of many small matrices.
        in_air = np.einsum('bsjko,bsjkl->bsjol', np.conj(on_board), channels)
        parts = in_air.view(np.float32)
        snr = np.einsum('bsjkl,bsjkl->bsj', parts, parts)
        in_air /= (1 + snr)[..., None, None]
        return cls(analog, np.log1p(snr).sum(axis=-1), on_board, in_air)

    def improved(self, known: np.ndarray, paths: np.ndarray, fixed: np.ndarray) -> '_Waves':
        """Match configurations to the waves over `known` paths; return their waves on `paths`."""
        analog = _enabled(self.on_board * self.in_air, known, fixed)
        return _Waves.at(paths, analog, self.on_board)

    def best(self, n: int) -> '_Waves':
        """Return the `n` best configurations of each band, without repetitions if possible."""
        bands = np.arange(len(self.rate))[:, None]
        order = np.argsort(-self.rate, axis=1)
        ranked = self.rate[bands, order]
        is_repeated = np.zeros(order.shape, np.int8)
        is_repeated[:, 1:] = (
            ranked[:, :-1] - ranked[:, 1:] <= _MIN_DIFFERENCE * ranked[:, :-1])
        distinct = np.argsort(is_repeated, axis=1, kind='stable')[:, :n]
        chosen = bands, order[bands, distinct]
        return _Waves(*(values[chosen] for values in self))


def _enabled(pairs: np.ndarray, paths: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Enable the elements where pairs of waves, complex64 [N_B, n, J, K, L], are in phase."""
    n_bands, n_elements = paths.shape[:2]
    weights = pairs.reshape(n_bands, -1, paths[0, 0].size).view(np.float32)
    gains = paths.reshape(n_bands, n_elements, -1).view(np.float32)
    return _in_phase(weights @ np.swapaxes(gains, 1, 2), fixed)


def _in_phase(products: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    return ((products > 0) | fixed).astype(np.float32)
