"""Energy, information and moments of Gaussians, and elimination of nuisance parameters."""

import math
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.constants import POWER_NEPERS_PER_DB
from rhs_isac_ros.model.scenario import Scenario, ScenarioError

# Standard deviation of the multipath level of a user without a direct path [dB].
BLOCKED_STD_DB = 10.0
# Logarithms of energies per number at which averages over a level are known: ends and step.
_LOG_ENERGIES = -7.0, 14.0, 0.01
# Share of valid signals that a test of the energy of a positioning phase may reject.
FALSE_ALARM = 1e-9
# Smallest square of a pivot relative to the largest variance, in units of the rounding error of n
# variances. Below it, bounds have errors of more than about a per cent.
_MIN_PIVOT = 4
# Largest difference from a symmetric matrix, relative to the largest element.
_ASYMMETRY = 1e-6


class Marginal(NamedTuple):
    """Quadratic log-likelihood of the first n of n + Q unknowns, maximised over the other Q."""

    # Schur complement of the information [N, n, n], and gradient of the log-likelihood [N, n].
    information: np.ndarray
    gradient: np.ndarray
    # Derivative of the maximising Q unknowns with respect to the first n, [N, Q, n], and the step
    # from the current Q unknowns to the maximising ones, [N, Q].
    regression: np.ndarray
    offset: np.ndarray
    # Log of the integral over the Q unknowns relative to the maximum [N], without factors of 2 pi.
    log_volume: np.ndarray


def covariance_problem(covariances: np.ndarray) -> str:
    """Describe matrices [C, D, D] that are no covariances with inverses; return '' if they are."""
    smallest = np.linalg.eigvalsh(covariances).min(initial=np.inf)
    asymmetry = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(initial=0.0)
    if smallest > 0 and asymmetry <= _ASYMMETRY * np.abs(covariances).max(initial=0.0):
        return ''
    return (f'eigenvalue {smallest:g}, asymmetry {asymmetry:g}, expected symmetric matrices with '
            'positive eigenvalues')


def covariance_root(scenario: Scenario, covariance: np.ndarray, *, orthogonal: bool = False
                    ) -> np.ndarray:
    """Compute Cholesky factors, or such with orthogonal columns, of covariances [..., n, n].

    The covariances are those of received signals. With orthogonal columns, whitening also
    diagonalises the part of the thermal noise.

    Raises ScenarioError if the noise is so weak, compared with the multipath, that the factors
    would be dominated by rounding errors.
    """
    largest = np.diagonal(covariance, axis1=-2, axis2=-1).real.max(axis=-1)
    limit = _MIN_PIVOT * covariance.shape[-1] * np.finfo(float).eps * largest
    try:
        roots = np.linalg.cholesky(covariance)
        smallest = np.diagonal(roots, axis1=-2, axis2=-1).real.min(axis=-1)**2
    except np.linalg.LinAlgError:
        smallest = -np.ones(1)
    if not (smallest >= limit).all():
        names = ('max_power_w', 'element_gain', 'user_gain', 'element_error_rms',
                 'failed_element_share', *(('multipath',) if scenario.multipath else (
                     'multipath_to_los_db', 'delay_spread_s', 'angular_spread_deg',
                     'max_user_speed_mps')))
        fields = ', '.join(f'{name} {getattr(scenario, name)}' for name in names)
        raise ScenarioError(
            f'noise_psd_dbm_hz: {scenario.noise_psd_dbm_hz:g} dBm/Hz, expected stronger noise: '
            f'with {fields}, the covariance of the signals is singular up to rounding errors')
    if orthogonal:
        values, vectors = np.linalg.eigh(covariance)
        return vectors * np.sqrt(np.maximum(values, scenario.noise_power_w))[..., None, :]
    return roots


def inverse_lower(roots: np.ndarray) -> np.ndarray:
    """Invert lower triangular matrices [..., n, n]."""
    # Every node imports this package, and SciPy takes longer to load than ROS.
    from scipy.linalg.lapack import get_lapack_funcs

    (inverted,) = get_lapack_funcs(('trtri',), (roots,))
    inverse = np.empty(roots.shape, roots.dtype)
    # LAPACK stores columns, in which lower matrices are upper ones.
    for index in np.ndindex(roots.shape[:-2]):
        inverse[index] = inverted(roots[index].T)[0].T
    return inverse


def energy_limit(n: int, probability: float = FALSE_ALARM) -> float:
    """Return the energy that n complex normal numbers of variance 1 exceed with `probability`."""
    # Half a chi-square variable with 2 n degrees of freedom is a gamma variable of shape n.
    from scipy.special import gammainccinv

    return float(gammainccinv(n, probability))


def log_evidence_of_level(
        energies: np.ndarray, count: int, std_db: float, median_db: float = 0.0,
        noise: float | np.ndarray = 0.0) -> np.ndarray:
    """Average the likelihood of Gaussian numbers over their level, a log-normal power.

    `energies`, float64 [N, K], are those of K groups of complex numbers relative to the variance
    of a number at 0 dB, and `count` is the size of each group. `noise` is the share of this
    variance that does not depend on the level. Returns the logarithm of the average, float64 [N],
    relative to the likelihood of zeros at 0 dB.
    """
    std, n = POWER_NEPERS_PER_DB * std_db, count * energies.shape[1]
    # As a function of the level, the likelihood has a width of n**-0.5, which the grid resolves.
    normal = np.linspace(-4, 4, 2 * int(np.ceil(4 * std * np.sqrt(n))) + 61)
    level, prior = POWER_NEPERS_PER_DB * median_db + std * normal, -normal**2 / 2
    power = noise + (1 - noise) * np.exp(level)[:, None]
    exponents = prior - energies @ (1 / power).T - count * np.log(power).sum(axis=1)
    return mixture_weights(exponents)[1] - mixture_weights(prior)[1]


class UnknownLevel:
    """Averages of likelihoods over the level of the multipath, a log-normal power.

    The level is that of n complex Gaussian numbers, with a median and a standard deviation [dB].
    By default, it is known to be 0 dB.
    """

    def __init__(self, n: int = 1, level_db: tuple[float, float] = (0.0, 0.0)) -> None:
        self.is_known = level_db == (0.0, 0.0)
        self._log_energies = np.log(n) + np.arange(*_LOG_ENERGIES)
        energies = np.exp(self._log_energies)
        self._gains = np.zeros(len(energies)) if self.is_known else (
            log_evidence_of_level(energies[:, None], n, level_db[1], level_db[0]) + energies)

    def gain(self, energy: np.ndarray) -> np.ndarray:
        """Return logs of averages relative to likelihoods at 0 dB, for residual energies [...]."""
        return np.interp(np.log(np.maximum(energy, np.finfo(float).tiny)),
                         self._log_energies, self._gains)


AT_0_DB = UnknownLevel()


def share_of_level(n: float, std_db: float) -> float:
    """Return the share of the variance of a log energy, from 0 to 1, that an unknown level causes.

    The energy is that of n complex Gaussian numbers, whose common level is a log-normal power. On
    average, the level also causes this share of the deviation of a log energy from its median.
    """
    variance = (POWER_NEPERS_PER_DB * std_db)**2
    return variance / (variance + 1 / n)


def quadratic_form(whitened: np.ndarray) -> np.ndarray:
    """Compute 2 Re(D^H Lambda^-1 D), float64 [N, G, G], as in Eq. (12).

    Takes the transpose of L^-1 D, complex128 [N, G, ...], where L L^H = Lambda.
    """
    size = math.prod(whitened.shape[2:])
    rows = np.ascontiguousarray(whitened.reshape(*whitened.shape[:2], size))
    # Re(a^H b) is the inner product of real and imaginary parts.
    parts = rows.view(whitened.real.dtype)
    return 2 * np.matmul(parts, np.swapaxes(parts, 1, 2))


def step_to_maximum(information: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Compute the Gauss-Newton step [..., Q] for information [..., Q, Q] and gradient [..., Q]."""
    return np.linalg.solve(information, gradient[..., None])[..., 0]


def marginalise(information: np.ndarray, gradient: np.ndarray, n: int = 3) -> Marginal:
    """Integrate a likelihood over all but the first n unknowns, by Laplace's method.

    Takes the information, float64 [N, n + Q, n + Q], and the gradient, float64 [N, n + Q], of the
    log-likelihood.
    """
    if information.shape[1] == n:
        n_points = len(gradient)
        return Marginal(information, gradient, np.zeros((n_points, 0, n)),
                        np.zeros((n_points, 0)), np.zeros(n_points))
    among, coupling = information[:, n:, n:], information[:, n:, :n]
    both = np.linalg.solve(
        among, np.concatenate([-coupling, gradient[:, n:, None]], axis=2))
    regression, offset = both[..., :-1], both[..., -1]
    explained = np.matmul(np.swapaxes(coupling, 1, 2), regression)
    return Marginal(
        information[:, :n, :n] + (explained + np.swapaxes(explained, 1, 2)) / 2,
        gradient[:, :n] + np.einsum('mqp,mq->mp', regression, gradient[:, n:]),
        regression, offset, -np.linalg.slogdet(among)[1] / 2)


def log_bessel(argument: np.ndarray) -> np.ndarray:
    """Approximate log I_0 of non-negative numbers; the error is below 0.04."""
    # Exact to first order at 0 and to the leading order for large arguments.
    growth = 1 + (np.pi - 1) * argument / (1.364 + argument)
    return argument - np.log(1 + 2 * argument * growth) / 2


def likelihood_loss(offset: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Compute the decrease of the log-likelihood over offsets [M, n] from modes, float64 [M]."""
    return np.einsum('mp,mpq,mq->m', offset, curvature, offset) / 2


def moments(weights: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [..., n] and covariance [..., n, n] of points [..., S, n]; weights add to 1."""
    mean = np.matmul(weights[..., None, :], points)
    offsets = points - mean
    return mean[..., 0, :], np.matmul(np.swapaxes(offsets * weights[..., None], -1, -2), offsets)


def symmetric(covariances: np.ndarray) -> np.ndarray:
    """Return matrices [..., n, n] without the asymmetry that rounding causes."""
    return (covariances + np.swapaxes(covariances, -1, -2)) / 2
