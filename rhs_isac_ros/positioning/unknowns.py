"""Nuisance parameters of the received signals, as the estimators eliminate them.

A scenario may declare unknown gains and phases; see `rhs_isac_ros.model.nuisance`. Each is a
factor exp(theta P) of direct path and multipath. Thermal noise is far weaker than the multipath,
so that the signals divided by the factor have the distribution of the model without it, apart
from the change of volume: the log-likelihood of position and theta is
``-|W (y exp(-theta P)) - t|^2 - 2 n theta_gain``, with n complex measurements.
"""

import numpy as np

from rhs_isac_ros.model.nuisance import nuisance_parameters, nuisance_patterns
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Standard deviation from which a wrapped phase is treated as uniform [rad].
UNIFORM_STD_RAD = 2.0
# Standard deviation from which the search treats the phases of the bands as uniform. Their joint
# density then has many peaks along the range, too narrow for Gaussians; `band_phases` adds its
# information afterwards.
COARSE_STD_RAD = 0.75
# Standard deviation of a Gaussian whose density at its centre is that of the uniform phase.
_UNIFORM_EQUIVALENT = np.sqrt(2 * np.pi)
# Smallest standard deviation, in the unit of the parameter: without effect, but its inverse
# square is finite in single precision.
_MIN_STD = 1e-15
# Parameters that move the signals out of the nulls of the multipath, so that they must be known
# before the search.
_SHARP = ('carrier_offset', 'timing')
# Grid of the sharp parameters, in standard deviations, and its number of points.
_REACH = 4.0
_N_SHARP = {1: 513, 2: 49}
_N_POLISH = 4


class Unknowns:
    """The nuisance parameters of a scenario.

    Phases of the bands whose standard deviation reaches `COARSE_STD_RAD` are uniform here. A
    phase of all bands is then omitted, because it has no effect.

    Attributes
    ----------
    patterns
        Exponent per unit of each parameter, complex128 [Q, N_B, N_SB F].
    std
        Standard deviations, float64 [Q]; of uniform phases, the equivalent one.
    precision
        Inverse variances of the prior, float64 [Q]; 0 for uniform phases.
    gain
        Index of the gain, None if it is known.
    information
        Fisher information from the covariance of the signals, float64 [Q, Q]:
        tr(L^-1 dL L^-1 dL'), in which the multipath reveals a gain and offsets of carrier and
        timing, but no phase.
    phase_std_rad, band_phase_std_rad
        Standard deviations of the phases; infinite if uniform.
    prior_phase_std_rad, prior_band_phase_std_rad
        Those that the scenario declares, infinite if they carry no information.
    """

    def __init__(self, model: WhitenedModel) -> None:
        scenario = model.scenario
        parameters = nuisance_parameters(scenario)
        self.phase_std_rad = _phase_std(scenario.phase_std_rad)
        self.prior_phase_std_rad = self.phase_std_rad
        self.prior_band_phase_std_rad = _phase_std(scenario.band_phase_std_rad)
        self.band_phase_std_rad = (
            self.prior_band_phase_std_rad
            if self.prior_band_phase_std_rad < COARSE_STD_RAD else np.inf)
        kept = [q for q, parameter in enumerate(parameters)
                if parameter.name != 'phase' or np.isfinite(self.band_phase_std_rad)]
        self.names = [parameters[q].name for q in kept]
        self.patterns = nuisance_patterns(scenario)[kept]
        std = np.array([max(parameters[q].std, _MIN_STD) for q in kept])
        uniform = np.array([name in ('phase', 'band_phase') for name in self.names], bool)
        uniform &= std > UNIFORM_STD_RAD
        if self.is_coarse:
            uniform |= np.array([name == 'band_phase' for name in self.names], bool)
        self.std = np.where(uniform, _UNIFORM_EQUIVALENT, std)
        self.precision = np.where(uniform, 0.0, 1 / std**2)
        self.gain = self.names.index('gain') if 'gain' in self.names else None
        self.sharp = [q for q, name in enumerate(self.names) if name in _SHARP]

        self._operators = model.whitened_operators(self.patterns)
        both = self._operators + np.conj(np.swapaxes(self._operators, 2, 3))
        self.information: np.ndarray = np.einsum('aimn,binm->ab', both, both).real

    @property
    def is_coarse(self) -> bool:
        """Whether the phases of the bands are uniform, so that the range is known coarsely."""
        return bool(np.isinf(self.band_phase_std_rad))

    def whitened_slopes(self, whitened: np.ndarray) -> np.ndarray:
        """Compute W P W^-1 times whitened signals [M, N_B, N_SB F], [M, Q, N_B N_SB F]."""
        slopes = np.einsum('qimn,kin->kqim', self._operators, whitened, optimize=True)
        return np.ascontiguousarray(slopes.reshape(*slopes.shape[:2], -1))

    def factors(self, values: np.ndarray) -> np.ndarray:
        """Compute exp(-theta P) for values [..., Q], complex128 [..., N_B, N_SB F]."""
        factors: np.ndarray = np.exp(-np.tensordot(values, self.patterns, axes=1))
        return factors


class Alignment:
    """Estimates of the sharp parameters from the signals alone, whatever the position.

    The position contributes the covariance of the mean signals over the region.
    """

    def __init__(self, model: WhitenedModel, unknowns: Unknowns, filters: np.ndarray) -> None:
        self._model, self._unknowns = model, unknowns
        n_points, n_rows = filters.shape[1:]
        templates = filters.astype(complex).conj()
        spread = np.matmul(np.swapaxes(templates, 1, 2), templates.conj()) / n_points
        roots = np.linalg.cholesky(spread + np.eye(n_rows))
        self._whitener = np.linalg.inv(roots)

    def values(self, received: np.ndarray) -> np.ndarray:
        """Return parameters [Q] for signals [N_B, N_SB F]; those that are not sharp are 0."""
        unknowns, n_values = self._unknowns, len(self._unknowns.names)
        values = np.zeros(n_values)
        if not unknowns.sharp:
            return values
        axes = [unknowns.std[q] * np.linspace(-_REACH, _REACH, _N_SHARP[len(unknowns.sharp)])
                for q in unknowns.sharp]
        grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, len(axes))
        candidates = np.zeros((len(grid), n_values))
        candidates[:, unknowns.sharp] = grid
        signals = self._whitened(received * unknowns.factors(candidates))
        cost = self._cost(np.sum(np.abs(signals)**2, axis=(1, 2)), candidates)
        values[:] = candidates[np.argmin(cost)]
        precision = np.diag(unknowns.precision[unknowns.sharp])
        for _ in range(_N_POLISH):
            aligned = received * unknowns.factors(values)
            residual = self._whitened(aligned[None]).reshape(-1)
            slopes = self._whitened(unknowns.patterns[unknowns.sharp] * aligned)
            slopes = slopes.reshape(len(slopes), -1)
            scale = self._scale(float(np.sum(np.abs(residual)**2)))
            curvature = 2 * scale * (slopes.conj() @ slopes.T).real + precision
            gradient = 2 * scale * (slopes.conj() @ residual).real
            gradient -= precision @ values[unknowns.sharp]
            values[unknowns.sharp] += np.linalg.solve(curvature, gradient)
        return values

    def _scale(self, energy: float) -> float:
        """Weight of the energy: an unknown gain normalises it."""
        return (1.0 if self._unknowns.gain is None
                else float(np.prod(self._model.shape)) / energy)

    def _cost(self, energy: np.ndarray, values: np.ndarray) -> np.ndarray:
        if self._unknowns.gain is not None:
            energy = float(np.prod(self._model.shape)) * np.log(energy)
        total: np.ndarray = energy + values**2 @ self._unknowns.precision / 2
        return total

    def _whitened(self, signals: np.ndarray) -> np.ndarray:
        whitened: np.ndarray = np.einsum(
            'irs,nis->nir', self._whitener, self._model.whiten(signals))
        return whitened


def _phase_std(std: float) -> float:
    if std == 0:
        return 0.0
    return np.inf if std > UNIFORM_STD_RAD else max(std, _MIN_STD)
