"""The prior of the nuisance parameters, and what the search maximises over them on the grid."""

import functools

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import multiply_rows
from rhs_isac_ros.model.geometry import (
    jacobian,
    polar_derivative,
    to_positions,
    velocity_std_mps,
)
from rhs_isac_ros.model.impairments import (
    UNIFORM_STD_RAD,
    Exponents,
    nuisance_of,
)
from rhs_isac_ros.model.scenario import ScenarioError
from rhs_isac_ros.positioning.lattice import Resolution, carrier_wavenumbers

# Standard deviation of a Gaussian whose density at its centre equals that of a uniform phase.
UNIFORM_EQUIVALENT = np.sqrt(2 * np.pi)
# Standard deviation from which the search treats the phases of the bands as uniform. Their joint
# density then has many peaks along the range, too narrow for Gaussians. Its information is added
# to the samples of the posterior afterwards.
COARSE_STD_RAD = 0.75
# Variance of a rate that is known up to half a step.
_STEP_VARIANCE = 1 / 12
# Largest logarithm of the power of noise relative to signals, which keeps it finite.
_MAX_EXPONENT = 300.0


class NuisancePrior(Exponents):
    """Prior and effect of the nuisance parameters, in units in which they are standard normal.

    A uniform phase has a flat prior and the unit `UNIFORM_EQUIVALENT`. If the relative phases of
    bands vary by `COARSE_STD_RAD` or more, uniform phases of all bands replace the parameters that
    rotate whole bands; the range then follows from delays, amplitudes and wavefronts only. So they
    do if users move: the range changes by wavelengths within a cycle.

    The velocity of a user who moves is one of the parameters, and its components come first. It
    has no exponents; see `states`.
    """

    velocity: np.ndarray  #: Velocity [m/s] per unit of the first D parameters, float64 [3, D].

    phase_covariance: np.ndarray  #: Of the declared phases of the bands, float64 [N_B, N_B].
    relative_phase_std_rad: float  #: Largest standard deviation relative to their mean.
    is_coarse: bool  #: Whether every band is given a uniform phase, by the last parameters.
    needs_search: np.ndarray  #: As in `Nuisance`, bool [Q].
    phases: np.ndarray  #: Phase of each band per unit [rad], float64 [N_B, Q].
    #: Information of the prior, as in `Nuisance`, but 0 for a uniform phase, float64 [Q].
    precision: np.ndarray
    gains: np.ndarray  #: Of the bands per unit of each parameter [nepers], float64 [N_B, Q].
    has_gain: bool  #: Whether any of them is not negligible.
    #: Half of the change of a parameter that does not change the signals, float64 [Q].
    half_period: np.ndarray
    information: np.ndarray  #: Contribution of the model's covariance, float64 [Q, Q].
    multipath_share: np.ndarray  #: That of `share_of_multipath`, float64 [Q].
    noise_share: float  #: Largest share of thermal noise in a whitened measurement.

    def __init__(self, model: MeasurementModel) -> None:
        self.scenario, declared = model.scenario, nuisance_of(model.scenario)
        self.phase_covariance = declared.phases @ declared.phases.T
        self.relative_phase_std_rad = _relative_std(self.phase_covariance)
        std = np.diag(velocity_std_mps(self.scenario))
        self.velocity = std[:, std.any(axis=0)]
        n_moving = self.velocity.shape[1]
        self.is_coarse = self.relative_phase_std_rad >= COARSE_STD_RAD or n_moving > 0
        kept = ~(declared.phases.any(axis=0) & self.is_coarse)
        _, n_bands, n_rows = declared.scaled_patterns.shape
        turns = UNIFORM_EQUIVALENT * np.eye(n_bands)[:n_bands * self.is_coarse]
        patterns = np.concatenate([
            np.zeros((n_moving, n_bands, n_rows)), declared.scaled_patterns[kept],
            1j * turns[:, :, None] * np.ones(n_rows)])
        phases = np.hstack([np.zeros((n_bands, n_moving)), declared.phases[:, kept], turns.T])
        around = (n_moving, len(turns))
        self.needs_search, self.moves_multipath = (
            np.pad(flags[kept], around)
            for flags in (declared.needs_search, declared.moves_multipath))
        largest = np.abs(phases).max(axis=0, initial=0.0)
        uniform = largest > UNIFORM_STD_RAD
        scale = np.where(uniform, UNIFORM_EQUIVALENT / np.where(uniform, largest, 1.0), 1.0)
        self.scaled_patterns, self.phases = patterns * scale[:, None, None], phases * scale
        precision, period = (
            np.pad(values[kept], around, constant_values=(of_velocity, 0.0))
            for values, of_velocity in ((declared.precision, 1.0), (declared.period, np.inf)))
        if (self.scenario.timing_std_s == np.inf and self.scenario.n_subbands % 2 == 0
                and not np.isinf(self.phase_std_rad).all()):
            raise ScenarioError(
                'timing_std_s: unknown, expected an unknown phase_std_rad or band_phase_std_rad '
                'as well: half a period of the timing turns all phases by half a turn')
        self.precision, self.half_period = np.where(uniform, 0.0, precision), period / 2
        self.gains, self.has_gain = self.scaled_patterns.real.mean(axis=2).T, declared.has_gain
        self._operators = self.operators(model.root, model.whitener)
        self.information = self.information_of(model.root, model.whitener)
        self.multipath_share = self.share_of_multipath(model.root, model.whitener)
        self.noise_share = self.scenario.noise_power_w * float(
            np.sum(np.abs(model.whitener)**2, axis=2).max())

    @property
    def _turns_together(self) -> bool:
        """Whether the search compares the bands as if all phases were off by the same angle."""
        return not self.is_coarse and not self.relative_phase_std_rad

    @functools.cached_property
    def gain(self) -> np.ndarray:
        """Gain of all signals per unit [nepers], float64 [Q]."""
        return self.scaled_patterns.real.mean(axis=(1, 2))

    @functools.cached_property
    def gain_unit(self) -> float:
        """Gain [nepers] per unit of its density; the standard deviation unless it is unknown."""
        return float(np.linalg.norm(self.gain))

    @functools.cached_property
    def gain_std(self) -> float:
        """Standard deviation of the gain of all signals [nepers]; 0 if it is negligible.

        It is far above `gain_unit` if the gain has no prior.
        """
        return self.has_gain * float(np.sqrt(self.gain @ self._gain_variance))

    @functools.cached_property
    def least_information(self) -> np.ndarray:
        """Information about parameters without a prior that move a gain by a neper, [Q].

        Where noise hides the signals, any lower gain is as likely. Evidences of several hypotheses
        are then comparable, as each contains an equal part of these gains.
        """
        found: np.ndarray = np.where(self.precision < 1, np.mean(self.gains**2, axis=0), 0.0)
        return found

    @functools.cached_property
    def _gain_variance(self) -> np.ndarray:
        """Covariance of the parameters with the gain of all signals [nepers], float64 [Q]."""
        return self.gain / np.where(self.gain == 0, 1.0, self.precision)

    @functools.cached_property
    def volume(self) -> np.ndarray:
        """Change of the logarithm of the signals' volume per unit, float64 [Q]."""
        return 2 * self.scaled_patterns.real.sum(axis=(1, 2))

    @functools.cached_property
    def phase_std_rad(self) -> np.ndarray:
        """Standard deviation of the phase of each band, infinite if it is uniform, [N_B]."""
        std = np.sqrt(np.diagonal(self.phase_covariance))
        return np.where(self.is_coarse | (std > UNIFORM_STD_RAD), np.inf, std)

    @functools.cached_property
    def floor(self) -> np.ndarray:
        """Curvature in (r, u, v) that is added to every log-likelihood, float64 [3]."""
        return Resolution.of(self.scenario).curvature_floor

    def direct_information(self, spread: np.ndarray) -> np.ndarray:
        """Compute the information of whitened means with second moments `spread`, [Q, Q]."""
        return 2 * np.einsum('aimn,ino,bimo->ab', self._operators, spread, self._operators.conj(),
                             optimize=True).real

    def states(self, points: np.ndarray, values: np.ndarray, moves: bool = True,
               turns: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return the states of users at points [M, 3] with parameters [M, Q], and derivatives.

        The derivatives, float64 [M, 3 or 6, P + D], are those with respect to the points, unless
        not `moves`, and to the D components of the velocity, which are 0 unless `turns`.
        """
        positions, by_point = to_positions(points), jacobian(points)[:, :, :3 * moves]
        n_moving, n_points = self.velocity.shape[1], by_point.shape[2]
        if not n_moving:
            return positions, by_point
        derivatives = np.zeros((len(points), 6, n_points + n_moving))
        derivatives[:, :3, :n_points], derivatives[:, 3:, n_points:] = (
            by_point, self.velocity * turns)
        return np.hstack([positions, values[:, :n_moving] @ self.velocity.T]), derivatives

    def velocities(self, values: np.ndarray, points: np.ndarray, levels: np.ndarray
                   ) -> np.ndarray:
        """Return velocities [M, 3] [m/s] at points for parameters [M, Q].

        An offset of the carrier resembles a radial speed. If both may turn the phase by more than
        a quarter of a turn within a band, the multipath leaves several offsets of similar
        likelihood, of which a search finds one. Only the turn by both together is then known, and
        the standard normal `levels` [M] divide it by the prior.
        """
        scenario, velocities = self.scenario, values[:, :self.velocity.shape[1]] @ self.velocity.T
        band_s = scenario.n_frames * scenario.frame_duration_s
        frames = self.scaled_patterns.reshape(
            *self.phases.T.shape, scenario.n_subbands, -1)[:, 0, 0].imag
        # Offsets of the carrier per unit [Hz]; then those that equal speeds [Hz s/m].
        offsets_hz = self.needs_search * (frames[:, -1] - frames[:, 0]) / (
            2 * np.pi * max(scenario.n_frames - 1, 1) * scenario.frame_duration_s)
        away = jacobian(points)[:, :, 0] * carrier_wavenumbers(scenario).mean() / (2 * np.pi)
        along = away @ self.velocity @ self.velocity.T
        # Across the line of sight, speeds do not turn the phase.
        of_speed = np.maximum(np.sum(along * away, axis=1), np.finfo(float).tiny)
        of_offset = np.sum(offsets_hz**2)
        offset_hz = values @ offsets_hz
        share = of_offset / (of_offset + of_speed)
        turn_hz = offset_hz - np.sum(away * velocities, axis=1)
        change_hz = share * turn_hz + np.sqrt(share * of_speed) * levels - offset_hz
        is_unclear = np.minimum(of_speed, of_offset) * band_s**2 > 1 / 16
        return velocities + (is_unclear * change_hz / of_speed)[:, None] * along

    def rates(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the rates of (r [m], u, v) at points for parameters [M, Q], [M, 3] [1/s].

        Without velocities, the result is [M, 0].
        """
        n_moving = self.velocity.shape[1]
        if not n_moving:
            return np.zeros((len(points), 0))
        velocities = values[:, :n_moving] @ self.velocity.T
        return np.matmul(polar_derivative(points), velocities[..., None])[..., 0]

    def carried(self, values: np.ndarray, points: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return parameters [M, Q] at target points for those at points, with equal polar rates.

        Signals determine these rates, so they hardly change within a mode.
        """
        return self.with_rates(values, target, self.rates(values, points))

    def with_rates(self, values: np.ndarray, points: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return parameters [M, Q] whose rates at points are nearly `rates`, [M, 3] [1/s].

        In a plane or on a line, users cannot have all rates: these are the nearest ones, in steps
        over which signals change. Where rates of a step need more than the declared velocity, it
        remains nearly that of the given parameters.
        """
        n_moving = self.velocity.shape[1]
        if not n_moving:
            return values
        steps = Resolution.of(self.scenario).rate_steps[:, None]
        slopes = np.matmul(polar_derivative(points), self.velocity) / steps
        misses = (rates - self.rates(values, points))[..., None] / steps
        transposed = np.swapaxes(slopes, 1, 2)
        change = np.linalg.solve(np.matmul(transposed, slopes) + _STEP_VARIANCE * np.eye(n_moving),
                                 np.matmul(transposed, misses))
        return np.hstack([values[:, :n_moving] + change[..., 0], values[:, n_moving:]])

    def columns(self, values: np.ndarray, received: np.ndarray, mean: np.ndarray,
                slopes: np.ndarray, *linear: np.ndarray) -> np.ndarray:
        """Stack the fields of `Columns`, before whitening, complex128 [M, C, N_B, N_SB F].

        `slopes` are the derivatives of the mean with respect to point and velocity.
        """
        divided, n_moving = self.divide(received, values), self.velocity.shape[1]
        n_points = slopes.shape[1] - n_moving
        share = self.multipath_share[:, None, None]
        expected = self.scaled_patterns * ((1 - share) * mean[:, None] + share * divided[:, None])
        return np.concatenate([
            (divided - mean)[:, None], slopes, expected[:, n_moving:], *linear,
            slopes[:, n_points:], (self.scaled_patterns * divided[:, None])[:, n_moving:]], axis=1)

    def slopes(self, whitened: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multiply whitened signals and means, [M, N_B, N_SB F], by W P W^-1.

        Returns `by_values` and `observed` of `Columns`, [M, Q, N_B N_SB F]; they are one array if
        they are equal.
        """
        # P is the same in all measurements of a band, unless it moves the multipath.
        constants, shares = self.scaled_patterns[:, :, :1], self.multipath_share
        observed = constants * np.broadcast_to(whitened, mean.shape)[:, None]
        expected = observed if (shares == 1).all() else constants * mean[:, None]
        for row in np.flatnonzero(self.moves_multipath):
            observed[:, row] = multiply_rows(self._operators[row], whitened)
            expected[:, row] = observed[:, row] if shares[row] == 1 else (
                shares[row] * observed[:, row]
                + (1 - shares[row]) * multiply_rows(self._operators[row], mean))
        shape = (*observed.shape[:2], mean[0].size)
        flat = observed.reshape(shape)
        return flat if expected is observed else expected.reshape(shape), flat

    def log_prior(self, values: np.ndarray) -> np.ndarray:
        """Return the logarithm of the prior times the change of volume, float64 [M]."""
        return -(values**2 @ self.precision / 2 + values @ self.volume)

    def log_evidence_of_aligned(self, aligned: np.ndarray) -> np.ndarray:
        """Return the log of Laplace's integral over the parameters [..., Q] of `Alignment`."""
        found: np.ndarray = self._log_volume - aligned**2 @ self.precision / 2
        return found

    @functools.cached_property
    def _log_volume(self) -> float:
        """Logarithm of the volume that `axes` span."""
        return float(np.linalg.slogdet(self.axes[:, self.moves_multipath])[1])

    @functools.cached_property
    def axes(self) -> np.ndarray:
        """Independent errors of D parameters of `Alignment`, of one standard deviation, [D, Q]."""
        (moves,) = np.nonzero(self.moves_multipath)
        found = np.zeros((len(moves), len(self)))
        found[:, moves] = np.linalg.cholesky(np.linalg.inv(
            self.information[np.ix_(moves, moves)] + np.diag(self.precision[moves]))).T
        return found

    def amplitude(self, outputs: np.ndarray) -> np.ndarray:
        """Add up the bands' matched-filter outputs, [N_B, ...], rotated as in `_in_phase`."""
        if self._turns_together:
            return _in_phase(outputs.sum(axis=0), float(self.phase_std_rad[0]))
        parts = [_in_phase(output, float(std))
                 for output, std in zip(outputs, self.phase_std_rad, strict=True)]
        return np.sum(parts, axis=0)

    def maximised_over_gain(self, amplitude: np.ndarray, energy: float | np.ndarray,
                            n_measurements: int) -> tuple[np.ndarray, np.ndarray]:
        """Maximise the log-likelihood, without the template's energy, over the gain.

        If signals y are multiplied by h, the log-likelihood for an amplitude A, an array of any
        shape, is ``-h^2 |y|^2 + 2 h A + 2 n log h`` plus the log-prior of the gain, which is
        ``-log h``; n is `n_measurements`. Returns its maximum and the gain [nepers]; if the gain
        is known, 2 A and a single 0.
        """
        if not self.gain_std:
            return 2 * amplitude, np.zeros(1)
        precision = self.gain_std**-2
        # The maximum without the prior, and its curvature, lead to a start for two Newton steps.
        positive = np.maximum(amplitude, 0)
        factor = (positive + np.sqrt(positive**2 + 4 * n_measurements * energy)) / (2 * energy)
        curvature = 2 * positive * factor + 4 * n_measurements
        gain = -np.log(factor) * curvature / (curvature + precision)
        for _ in range(2):
            factor = np.exp(-gain)
            slope = (2 * factor * (factor * energy - amplitude) - 2 * n_measurements
                     - precision * gain)
            curvature = 2 * factor * (2 * factor * energy - amplitude) + precision
            gain += slope / np.maximum(curvature, precision)
        factor = np.exp(-gain)
        return (factor * (2 * amplitude - factor * energy) - 2 * n_measurements * gain
                - precision * gain**2 / 2, gain)

    def start(self, outputs: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Return initial parameters [M, Q] for filter outputs [N_B, M] and gains [M] [nepers]."""
        angles = np.angle(outputs)
        if self._turns_together:
            angles = np.broadcast_to(np.angle(outputs.sum(axis=0)), angles.shape)
        # Phases without a prior follow the angles; the others share the rest by their variance.
        variance = np.where(self.precision > 0, 1.0, 1e6)
        spread = self.phases * variance
        values: np.ndarray = (spread.T @ np.linalg.pinv(spread @ self.phases.T) @ angles).T
        if self.gain_std:
            values += np.outer(gain, self._gain_variance / self.gain_std**2)
        return values

    def growth(self, gain: np.ndarray) -> np.ndarray:
        """Return factors of at least 1 for differences of log-likelihoods at gains [nepers].

        On the grid, the noise is that of a gain of 0. Divided by a lower gain, it is stronger, and
        the log-likelihoods of two positions are in error by up to such a factor each.
        """
        power = np.exp(np.clip(-2 * gain, 0.0, _MAX_EXPONENT))
        return 1 + 2 * self.noise_share * self.has_gain * (power - 1)

    def noise_weights(self, gains: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return factors of whitened measurements, and the shares of noise in them, [M, n] each.

        `gains` are those of the bands, [M, N_B] [nepers], and `noise` is the share of noise in
        each measurement at a gain of 0, [n] or [M, n].
        """
        power = np.exp(np.clip(-2 * gains, -_MAX_EXPONENT, _MAX_EXPONENT))
        power = np.repeat(power, noise.shape[-1] // gains.shape[1], axis=1)
        # Rounding may bring the share of noise above 1.
        total = np.maximum(1 - noise, 0.0) + noise * power
        return 1 / np.sqrt(total), noise * power / total

    def hidden(self, shares: np.ndarray) -> np.ndarray:
        """Return the part of `information` that thermal noise hides, [M, Q, Q].

        A gain does not scale the noise, whose shares of the measurements are those of
        `noise_weights`.
        """
        lost = np.sum((4 - 4 * (1 - shares)**2).reshape(len(shares), len(self.gains), -1), axis=2)
        gains = self.gains * ~self.moves_multipath
        found: np.ndarray = np.einsum('bq,mb,bp->mqp', gains, lost, gains)
        return found


def _relative_std(phase_covariance: np.ndarray) -> float:
    """Return the largest standard deviation of the bands' phases relative to their mean [rad]."""
    n_bands = len(phase_covariance)
    centre = np.eye(n_bands) - (1 / n_bands if n_bands > 1 else 0.0)
    relative = np.linalg.eigvalsh(centre @ phase_covariance @ centre)[-1]
    # If all bands share one phase, only rounding errors remain.
    is_shared = relative <= 1e-9 * np.trace(phase_covariance)
    return 0.0 if is_shared else float(np.sqrt(relative))


def _in_phase(outputs: np.ndarray, std: float) -> np.ndarray:
    """Return the real parts after the most likely rotation, less half its cost in the prior."""
    if std == 0:
        return outputs.real
    magnitude: np.ndarray = np.abs(outputs)
    if not np.isfinite(std):
        return magnitude
    angle = np.angle(outputs)
    phase = angle * magnitude / (magnitude + 1 / (2 * std**2))
    return magnitude * np.cos(angle - phase) - phase**2 / (4 * std**2)
