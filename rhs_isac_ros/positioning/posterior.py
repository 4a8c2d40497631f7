"""The posterior of a position, in the form in which a track needs it."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.modes import Modes


class Doubt(NamedTuple):
    """The possibility that the user is outside of the region of interest.

    Attributes
    ----------
    probability
        Probability that the user is outside.
    whitened
        Whitened signals without the offsets of carrier and timing, complex128 [N_B, N_SB F].
    scale
        Factor of the signals, from the gain, that is most probable outside.
    """

    probability: float
    whitened: np.ndarray
    scale: float


class Posterior(NamedTuple):
    """The posterior of one positioning phase, for a uniform prior on the region of interest.

    Attributes
    ----------
    estimate
        Its mean and covariance, or the reason why there is no position.
    modes
        Its modes; None without a position.
    whitened
        Whitened signals, complex128 [N_B, N_SB F].
    doubt
        The possibility that the user is outside of the region, which the covariance includes;
        None if it is negligible, or without a position.
    """

    estimate: Estimate
    modes: Modes | None
    whitened: np.ndarray
    doubt: Doubt | None
