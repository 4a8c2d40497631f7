"""Search for configurations that are worth an ascent, many starts at a time."""

import functools

import numpy as np

from rhs_isac_ros.link.band_link import BandLink

_STARTS = 320
# How many of them are left after each round.
_SURVIVORS = (320, 320, 160, 80, 80, 80, 80, 80, 80)
_TINY = 1e-300
# How far the phases of two sub-bands may drift apart over the surface before they are searched
# separately, and how many are at most.
_DRIFT_RAD = 1.0
_MOST_SUBBANDS = 16


def promising(link: BandLink, count: int) -> np.ndarray:
    """Find configurations of high capacity.

    By the holographic principle a configuration lets through where a wave on the board, s B, and a
    wave in the air, G w, meet in phase. The waves in the air are the line of sight and the modes
    of the multipath, the columns of G. From fixed pairs of waves, spread over all directions, both
    waves and the configuration are improved in turn: for a configuration, the best pair belongs to
    the largest singular value of B diag(c) G.

    Parameters
    ----------
    link
        The link.
    count
        How many configurations to return.

    Returns
    -------
    numpy.ndarray
        Different configurations, at most `count`, each entry 0 or 1, float64 [n, N_E], those of
        the highest capacity first as far as the sub-bands and modes searched tell.
    """
    paths = _paths(link)
    n_subbands, n_feeds, n_waves, n_elements = paths.shape
    # Real arithmetic: configurations are real, and so is what counts of the waves' product.
    by_element = paths.reshape(-1, n_elements).T.copy().view(float)
    on_board, in_air = _starts(n_feeds, n_waves)
    pairs = np.zeros((_STARTS, n_subbands, n_feeds, n_waves), complex)
    # Each start belongs to one sub-band at first.
    own = np.arange(_STARTS), np.arange(_STARTS) % n_subbands
    pairs[own] = on_board[:, :, None] * in_air[:, None, :]
    on_board = np.repeat(on_board[:, None], n_subbands, axis=1)
    for n in _SURVIVORS:
        product = np.conj(pairs).reshape(len(pairs), -1).view(float)
        analog = (product @ by_element.T > 0).astype(float)
        through = (analog @ by_element).view(complex).reshape(pairs.shape)
        ratio, on_board, pairs = _better_pairs(through, on_board)
        pairs /= (1 + ratio)[..., None, None]
        rate = np.log1p(ratio).sum(axis=1)
        if n < len(pairs):
            best = np.argpartition(-rate, n)[:n]
            analog, on_board, pairs, rate = analog[best], on_board[best], pairs[best], rate[best]
    # Starts may meet.
    different = {row.tobytes(): row for row in analog[np.argsort(-rate, kind='stable')]}
    return np.array(list(different.values())[:count])


def _better_pairs(
        through: np.ndarray, on_board: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bring pairs of waves closer to the best for configurations, by a step of power iteration.

    Takes B diag(c) G [S, J, K, L] and waves on the board [S, J, K]; returns the ratio of signal to
    noise [S, J], the new waves on the board, and the products of the new pairs [S, J, K, L].
    """
    in_air = np.conj(np.matmul(on_board[..., None, :], through))
    on_board = np.conj(np.matmul(through, np.swapaxes(in_air, -1, -2))[..., 0])
    on_board /= np.maximum(np.linalg.norm(on_board, axis=-1, keepdims=True), _TINY)
    in_air = np.conj(np.matmul(on_board[..., None, :], through))
    ratio = np.sum(np.abs(in_air)**2, axis=(-1, -2))
    return ratio, on_board, on_board[..., None] * in_air


def _paths(link: BandLink) -> np.ndarray:
    """Gain over noise from each feed by each element to each wave, complex128 [J, K, L, N_E].

    The power is shared evenly. Sub-bands that hardly differ are represented by one.
    """
    n_subbands = len(link.los)
    picked = _representatives(link)
    in_air = np.concatenate([
        link.los[picked][:, None], np.broadcast_to(
            link.modes.T, (len(picked), *link.modes.T.shape))], axis=1)
    scale = np.sqrt(link.power_w / n_subbands / link.noise_w)
    return scale * link.onboard[picked][:, :, None] * in_air[:, None]


def _representatives(link: BandLink) -> np.ndarray:
    """Indices of sub-bands, evenly spread, so many that the phases between them drift little."""
    n_subbands = len(link.los)
    # Across the whole band, what its last sub-band turns against the first, beyond a common turn.
    turn = link.onboard[-1] * link.los[-1] * np.conj(link.onboard[0] * link.los[0])
    spread = np.angle(turn * np.conj(turn.sum()))
    n = int(min(n_subbands, 1 + np.ptp(spread) // _DRIFT_RAD, _MOST_SUBBANDS))
    return ((np.arange(n) + 0.5) * n_subbands / n).astype(int)


@functools.lru_cache(maxsize=16)
def _starts(n_feeds: int, n_waves: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixed waves on the board and in the air, complex128 [S, K] and [S, L]."""
    rng = np.random.default_rng(0)
    return tuple(rng.normal(size=(_STARTS, n, 2)) @ [1, 1j] for n in (n_feeds, n_waves))
