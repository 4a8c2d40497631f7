"""Elimination of nuisance parameters from a Gaussian approximation of a likelihood."""

from typing import NamedTuple

import numpy as np


class Marginal(NamedTuple):
    """The Gaussian of the first n of n + Q unknowns, after the maximum over the others.

    Attributes
    ----------
    information
        Schur complement of the information, float64 [N, n, n].
    gradient
        Gradient of the log-likelihood, float64 [N, n].
    regression
        Change of the other unknowns with the first ones, float64 [N, Q, n].
    offset
        Step of the other unknowns to their maximum, float64 [N, Q].
    log_volume
        Logarithm of the integral over the others relative to the maximum, without the factors
        2 pi, float64 [N].
    """

    information: np.ndarray
    gradient: np.ndarray
    regression: np.ndarray
    offset: np.ndarray
    log_volume: np.ndarray


def eliminate(
        curvature: np.ndarray, coupling: np.ndarray, gradient: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximise a quadratic log-likelihood over nuisance parameters.

    Takes its curvature in these, float64 [N, Q, Q], their coupling with n other unknowns,
    [N, Q, n], and its gradient, [N, Q]. Returns how the maximum moves with the other unknowns, the
    negative coupling after a solution, [N, Q, n], and the step to the maximum, [N, Q].
    """
    both = np.linalg.solve(
        curvature, np.concatenate([-coupling, gradient[..., None]], axis=-1))
    return both[..., :-1], both[..., -1]


def marginalise(information: np.ndarray, gradient: np.ndarray, n: int = 3) -> Marginal:
    """Integrate over all but the first n unknowns, by Laplace's method.

    Takes information, float64 [N, n + Q, n + Q], and gradient, [N, n + Q], of a log-likelihood.
    """
    among, coupling = information[:, n:, n:], information[:, n:, :n]
    regression, offset = eliminate(among, coupling, gradient[:, n:])
    explained = np.matmul(np.swapaxes(coupling, 1, 2), regression)
    return Marginal(
        information[:, :n, :n] + (explained + np.swapaxes(explained, 1, 2)) / 2,
        gradient[:, :n] + np.einsum('mqp,mq->mp', regression, gradient[:, n:]),
        regression, offset, -np.linalg.slogdet(among)[1] / 2)
