"""The modes of the posterior with their probabilities."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.threads import one_blas_thread
from rhs_isac_ros.positioning.samples import draw_samples
from rhs_isac_ros.positioning.search import SearchEstimator


class WeightedModes(NamedTuple):
    """The posterior as a mixture of M components, the most probable first.

    Attributes
    ----------
    probabilities
        Float64 [M]; their sum is 1.
    positions
        Means of the components, float64 [M, 3] [m].
    covariances
        Float64 [M, 3, 3] [m^2].
    """

    probabilities: np.ndarray
    positions: np.ndarray
    covariances: np.ndarray


@one_blas_thread
def weighted_modes(estimator: SearchEstimator, received: np.ndarray) -> WeightedModes | None:
    """Compute the modes of the posterior for the signals of one phase.

    Mean and covariance of the mixture are those of the estimate of `BayesEstimator`, up to the
    uncertainty of the mean of its samples.

    Parameters
    ----------
    received
        Complex128 [N_B, N_SB F], or [N_B, N_SB, F].

    Returns
    -------
    WeightedModes or None
        None if the signals determine no position.

    Raises
    ------
    SignalError
        If the signals cannot be used.
    """
    modes = estimator.posterior(received.reshape(len(received), -1)).modes
    if modes is None:
        return None
    samples = draw_samples(modes, estimator.normal, estimator.scenario.roi_bounds_m)
    weights = np.exp(samples.log_weights - samples.log_weights.max())
    shares = weights.sum(axis=1)
    order = np.argsort(-shares)[:np.count_nonzero(shares)]
    shares, places = shares[order], samples.positions[order]
    weights = weights[order] / shares[:, None]
    means = np.einsum('ms,msa->ma', weights, places)
    offsets = places - means[:, None]
    covariances = np.einsum('ms,msa,msb->mab', weights, offsets, offsets)
    return WeightedModes(shares / shares.sum(), means, covariances)
