"""Search for configurations from which to start an ascent, many starts at a time."""

import functools

import numpy as np

from rhs_isac_ros.link.band_link import BandLink

_N_STARTS = 320
# Number of starts that remain after each round.
_N_KEPT = (320, 320, 160, 80, 80, 80, 80, 80, 80)
# Lower limit of a norm, which avoids a division by zero.
_MIN_NORM = 1e-300
# Sub-bands whose phases drift apart by more than this over the surface are searched separately,
# up to a limited number.
_MAX_DRIFT_RAD = 1.0
_MAX_SUBBANDS = 16


def candidate_configurations(link: BandLink, max_count: int) -> np.ndarray:
    """Find configurations of high capacity.

    By the holographic principle, a configuration enables those elements at which a wave on the
    board, s B, and a wave in the air, G w, are in phase. The waves in the air are the line of
    sight and the modes of the multipath, the columns of G. Starting from fixed pairs of waves,
    spread over all directions, the search improves waves and configuration in turn: the best pair
    for a configuration belongs to the largest singular value of B diag(c) G.

    Returns up to `max_count` different configurations, float64 [n, N_E], each entry 0 or 1, in
    descending order of the capacity over the sub-bands and modes that are searched.
    """
    paths = _paths(link)
    n_subbands, n_feeds, n_waves, n_elements = paths.shape
    # Real arithmetic suffices: configurations are real, and only the real part of the product of
    # the waves matters.
    path_matrix = paths.reshape(-1, n_elements).T.copy().view(float)
    on_board, in_air = _starts(n_feeds, n_waves)
    pairs = np.zeros((_N_STARTS, n_subbands, n_feeds, n_waves), complex)
    # Each start begins with a single sub-band.
    first_pair = np.arange(_N_STARTS), np.arange(_N_STARTS) % n_subbands
    pairs[first_pair] = on_board[:, :, None] * in_air[:, None, :]
    on_board = np.repeat(on_board[:, None], n_subbands, axis=1)
    for n_left in _N_KEPT:
        product = np.conj(pairs).reshape(len(pairs), -1).view(float)
        analog = (product @ path_matrix.T > 0).astype(float)
        analog[:, link.fixed] = 1.0
        configured = (analog @ path_matrix).view(complex).reshape(pairs.shape)
        snr, on_board, pairs = _improve_pairs(configured, on_board)
        pairs /= (1 + snr)[..., None, None]
        rate = np.log1p(snr).sum(axis=1)
        if n_left < len(pairs):
            best = np.argpartition(-rate, n_left)[:n_left]
            analog, on_board, pairs, rate = analog[best], on_board[best], pairs[best], rate[best]
    # Several starts may end in the same configuration.
    distinct = {row.tobytes(): row for row in analog[np.argsort(-rate, kind='stable')]}
    return np.array(list(distinct.values())[:max_count])


def _improve_pairs(
        configured: np.ndarray, on_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Improve pairs of waves for given configurations by a step of power iteration.

    Takes B diag(c) G [S, J, K, L] and waves on the board [S, J, K]; returns the signal-to-noise
    ratios [S, J], the new waves on the board, and the products of the new pairs [S, J, K, L].
    """
    in_air = np.conj(np.matmul(on_board[..., None, :], configured))
    on_board = np.conj(np.matmul(configured, np.swapaxes(in_air, -1, -2))[..., 0])
    on_board /= np.maximum(np.linalg.norm(on_board, axis=-1, keepdims=True), _MIN_NORM)
    in_air = np.conj(np.matmul(on_board[..., None, :], configured))
    snr = np.sum(np.abs(in_air)**2, axis=(-1, -2))
    return snr, on_board, on_board[..., None] * in_air


def _paths(link: BandLink) -> np.ndarray:
    """Gain over noise from each feed via each element to each wave, complex128 [J, K, L, N_E].

    The power is divided evenly among the sub-bands. One sub-band represents all that hardly
    differ.
    """
    n_subbands = len(link.los)
    subbands = _representative_subbands(link)
    in_air = np.concatenate([
        link.los[subbands][:, None], np.broadcast_to(
            link.modes.T, (len(subbands), *link.modes.T.shape))], axis=1)
    scale = np.sqrt(link.power_w / n_subbands / link.noise_power_w)
    paths: np.ndarray = scale * link.onboard[subbands][:, :, None] * in_air[:, None]
    return paths


def _representative_subbands(link: BandLink) -> np.ndarray:
    """Indices of evenly spread sub-bands, so close that the phases drift little between them."""
    n_subbands = len(link.los)
    # Rotation of the last sub-band against the first, without the rotation common to all elements.
    rotation = link.onboard[-1] * link.los[-1] * np.conj(link.onboard[0] * link.los[0])
    drift = np.angle(rotation * np.conj(rotation.sum()))
    n = int(min(n_subbands, 1 + np.ptp(drift) // _MAX_DRIFT_RAD, _MAX_SUBBANDS))
    return ((np.arange(n) + 0.5) * n_subbands / n).astype(int)


@functools.lru_cache(maxsize=16)
def _starts(n_feeds: int, n_waves: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixed waves on the board and in the air, complex128 [S, K] and [S, L]."""
    rng = np.random.default_rng(0)
    on_board: np.ndarray = rng.normal(size=(_N_STARTS, n_feeds, 2)) @ [1, 1j]
    in_air: np.ndarray = rng.normal(size=(_N_STARTS, n_waves, 2)) @ [1, 1j]
    return on_board, in_air
