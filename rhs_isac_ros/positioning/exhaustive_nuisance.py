"""The likelihood of positions with the nuisance parameters integrated out numerically.

Given the parameters, the signals are Gaussian: a gain g scales mean and multipath, not the noise,
and phases turn the signals. In the eigenvectors of the covariance, with eigenvalues l of which s
is due to the noise, every gain has a diagonal covariance ``g^2 (l - s) + s``, so that a point
contributes two matrix products to all phases and gains.
"""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.imperfections import has_element_errors
from rhs_isac_ros.model.nuisance import (
    NuisanceParameter,
    nuisance_parameters,
    nuisance_patterns,
)

# A phase of this standard deviation is uniform: see `Deviations` [rad].
_UNIFORM_RAD = 6.0
# Search for the relevant values of a parameter: reach in standard deviations, values per step,
# steps, positions, and the log-likelihood that values may be below the best.
_REACH = 5.0
_N_VALUES = 129
_N_ZOOMS = 6
_LOG2_POSITIONS = 13
_MARGIN = 14.0
# Spacing of the quadrature, in standard deviations at a known position.
_SPACING = 1.2


class NuisanceLikelihood:
    """Log-likelihood of positions, float32 [P, N], for signals [N, N_B, N_SB F].

    Uniform phases, of a cycle or of each band, have a closed form. One parameter besides, a gain,
    an offset or a phase that is not uniform, is integrated by the trapezoidal rule, which
    converges exponentially for densities of this form.

    Raises
    ------
    ValueError
        If the scenario declares several such parameters, phases of bands that are not uniform, or
        element errors.
    """

    def __init__(self, scenario: Scenario, codebook: Codebook, received: np.ndarray) -> None:
        self._model = MeasurementModel(scenario, codebook)
        self._noise = scenario.noise_power_w
        self._total, vectors = np.linalg.eigh(self._model.covariance())
        self._whitener = np.conj(np.swapaxes(vectors, 1, 2)) / np.sqrt(self._total)[..., None]
        self._root = vectors * np.sqrt(self._total)[:, None]
        self._parameter, self._pattern, self._free = _declared(scenario)
        self._received = received

        from scipy.stats import qmc
        low, high = scenario.roi_bounds_m
        points = qmc.Sobol(3, seed=1).random_base2(_LOG2_POSITIONS) * (high - low) + low
        templates = self._templates(points)
        nodes = [self._nodes(signals, templates) for signals in received]
        sizes = [len(values) for values in nodes]
        self._starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        self._columns = self._make_columns(
            np.repeat(received, sizes, axis=0), np.concatenate(nodes))

    def __call__(self, positions: np.ndarray) -> np.ndarray:
        """Evaluate positions [P, 3]."""
        values = self._evaluate(self._templates(positions), self._columns, self._free)
        highest = np.maximum.reduceat(values, self._starts, axis=1)
        sizes = np.diff(np.append(self._starts, values.shape[1]))
        values -= np.repeat(highest, sizes, axis=1)
        total: np.ndarray = highest + np.log(
            np.add.reduceat(np.exp(values, out=values), self._starts, axis=1))
        return total

    def _templates(self, positions: np.ndarray) -> np.ndarray:
        """Whitened means, complex64 [N_B, P, N_SB F]."""
        mean = np.swapaxes(self._model.mean(positions), 0, 1)
        templates: np.ndarray = np.matmul(mean, np.swapaxes(self._whitener, 1, 2))
        return templates.astype(np.complex64)

    def _make_columns(
            self, received: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Filters [N_B, C, N_SB F], weights of the energy [C, N_B N_SB F], and constants [C].

        Takes the signals [C, N_B, N_SB F] and the value of the parameter [C] of each column.
        """
        factors = np.exp(values[:, None, None] * self._pattern)
        # A gain scales the covariance, an imaginary exponent turns the signals.
        power = np.abs(factors)**2
        turned = received * np.conj(factors) / np.abs(factors)
        signals = np.einsum('bkm,cbm->cbk', self._whitener, turned)
        gain = power[:, 0, 0]
        variance = gain[:, None, None] * (self._total - self._noise) + self._noise
        precision = self._total / variance
        constant = -np.sum(precision * np.abs(signals)**2 + np.log(variance / self._total),
                           axis=(1, 2))
        if self._parameter:
            constant -= values**2 / (2 * self._parameter.std**2)
        filters = signals * np.sqrt(gain)[:, None, None] * precision
        scaled = gain[:, None, None] * precision
        weights = (scaled.reshape(len(values), -1).astype(np.float32)
                   if np.any(gain != 1) else None)
        return (np.swapaxes(filters, 0, 1).astype(np.complex64), weights,
                constant.astype(np.float32))

    def _evaluate(
            self, templates: np.ndarray, columns: tuple[np.ndarray, np.ndarray | None, np.ndarray],
            free: str) -> np.ndarray:
        """Log-likelihood of positions and columns with free phases: '', 'all' or 'band'."""
        filters, weights, constant = columns
        pairs = list(zip(templates, filters, strict=True))
        energy = np.abs(templates)**2
        values: np.ndarray
        if free == '':
            values = 2 * np.sum([_real_product(*pair) for pair in pairs], axis=0)
        elif free == 'all':
            values = _log_bessel(2 * np.abs(np.sum(
                np.matmul(templates.conj(), np.swapaxes(filters, 1, 2)), axis=0)))
        else:
            values = np.sum([_log_bessel(2 * np.abs(t.conj() @ f.T)) for t, f in pairs], axis=0)
        if weights is None:
            values -= energy.sum(axis=(0, 2))[:, None]
        else:
            values -= np.swapaxes(energy, 0, 1).reshape(energy.shape[1], -1) @ weights.T
        values += constant
        return values

    def _nodes(self, received: np.ndarray, templates: np.ndarray) -> np.ndarray:
        """Choose the values of the parameter over which a phase is integrated.

        They are those at which some position is likely if the phases of the bands are free, which
        makes it insensitive to the few positions that are tried.
        """
        if self._parameter is None:
            return np.zeros(1)
        low, high = np.array([-_REACH, _REACH]) * self._parameter.std
        for _ in range(_N_ZOOMS):
            values = np.linspace(low, high, _N_VALUES)
            columns = self._make_columns(np.repeat(received[None], _N_VALUES, axis=0), values)
            likelihood = self._evaluate(templates, columns, 'band')
            profile = likelihood.max(axis=0)
            best = int(np.argmax(profile))
            spacing = _SPACING / np.sqrt(self._parameter.std**-2 + self._information(
                templates[:, int(np.argmax(likelihood[:, best]))]))
            # Positions between those that are tried fit better than these.
            misfit = max(1.0, -float(profile[best]) / received.size)
            (likely,) = np.nonzero(profile >= profile[best] - _MARGIN * misfit)
            step = values[1] - values[0]
            low, high = values[likely[0]] - step, values[likely[-1]] + step
            if step <= 2 * spacing:
                break
        return np.arange(low, high + spacing, spacing)

    def _information(self, template: np.ndarray) -> float:
        """Fisher information about the parameter at a known position."""
        operator = np.matmul(self._whitener * self._pattern[:, None], self._root)
        both = operator + np.conj(np.swapaxes(operator, 1, 2))
        slope = np.einsum('bkm,bm->bk', operator, template)
        return float(np.sum(both * np.swapaxes(both, 1, 2)).real
                     + 2 * np.sum(np.abs(slope)**2))


def _declared(scenario: Scenario) -> tuple[NuisanceParameter | None, np.ndarray, str]:
    """Return the parameter to integrate numerically, its pattern, and the free phases."""
    free, parameter = '', None
    pattern = np.zeros((scenario.n_bands, scenario.n_subbands * scenario.n_frames), complex)
    candidates = zip(nuisance_parameters(scenario), nuisance_patterns(scenario), strict=True)
    for candidate, its_pattern in candidates:
        if candidate.name == 'band_phase' and candidate.std >= _UNIFORM_RAD:
            free = 'band'
        elif candidate.name == 'phase' and candidate.std >= _UNIFORM_RAD:
            free = free or 'all'
        elif parameter is None and candidate.name != 'band_phase':
            parameter, pattern = candidate, its_pattern
        else:
            raise ValueError(
                f'{candidate.name}: expected at most one parameter besides uniform phases')
    if has_element_errors(scenario):
        raise ValueError('element errors: expected no nuisance parameters beside them')
    return parameter, pattern, free


def _real_product(templates: np.ndarray, filters: np.ndarray) -> np.ndarray:
    """Real part of the products of conjugate rows [P, K] and rows [C, K], float32 [P, C]."""
    product: np.ndarray = templates.view(np.float32) @ filters.view(np.float32).T
    return product


def _log_bessel(argument: np.ndarray) -> np.ndarray:
    from scipy.special import i0e

    value: np.ndarray = argument + np.log(i0e(argument))
    return value
