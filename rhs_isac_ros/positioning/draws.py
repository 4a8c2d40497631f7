"""The posterior of weak signals: positions drawn all over the grid, instead of modes.

Signals below the noise fit positions in thousands of beams and range steps. A search for all modes
would be slow, and the modes are not Gaussian. Directions are therefore drawn in cells of the grid,
and the likelihood is integrated along the range. This is importance sampling: the probability of
drawing a cell follows from a bound of its likelihood, and the weight of a draw is its integral
divided by this probability. Peaks of strong signals are too narrow for this method.

The weights determine the effective number of draws. While this number is too small, further rounds
of draws also follow the weights found so far. Each round is unbiased, because its probabilities do
not depend on its own draws. Later rounds have larger weights (Owen and Zhou, The square root rule
for adaptive importance sampling, ACM Trans. on Modeling and Computer Simulation, 2020).
"""

import functools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.gaussian import moments
from rhs_isac_ros.positioning.estimate import Fit, regular
from rhs_isac_ros.positioning.grid import Draw, TemplateTable, Windows
from rhs_isac_ros.positioning.lattice import PHASE_ERROR, Resolution, carrier_wavenumbers
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.positioning.templates import Query


class Sampling(NamedTuple):
    """Numbers that trade the speed of the draws for their accuracy."""

    # Draws per round, largest number of rounds, and sufficient effective number of draws. The
    # inverse of this number is the relative increase of the mean squared error.
    draws: int = 500
    rounds: int = 12
    effective: float = 150.0
    # Share of the draws in further rounds that follow the bounds instead of the weights.
    share_of_bounds: float = 0.7
    # Exponent of the bounds of the likelihood, below 1 so that cells with low bounds are drawn.
    power: float = 0.8
    # Range windows are omitted if their bound is below the average of the best window by more.
    margin: float = 12.0
    # Smallest number of range steps per wavelength. Narrow peaks get one per two standard
    # deviations.
    steps: int = 8
    # How often groups of rays are divided, if they have at least a number of rays; and smallest
    # weight of a ray in a group, relative to the largest one.
    levels: int = 6
    divided: int = 16
    least: float = 1e-6
    # Number of range steps to evaluate at a time.
    block: int = 1 << 20
    # Largest log-likelihood, relative to no direct path, at which positions are drawn. Peaks of
    # stronger signals are so narrow that draws may hit some of them and miss others. Where other
    # surfaces may favour peaks of small shares, which groups of rays represent poorly, positions
    # are drawn only if the peaks are no higher than those of noise.
    largest: float = 100.0
    largest_favoured: float = 12.0


SAMPLING = Sampling()
# Smallest thickness of the region [wavelengths]. The likelihood hardly changes over it.
_MIN_THICKNESS = 0.05
# The multiples of this pair, modulo 1, cover the unit square evenly. Its numbers are powers of the
# inverse of the real root of x^3 = x + 1.
_SEQUENCE = 1.324717957244746**-np.array([1.0, 2.0])
# Smaller components of directions are replaced by this value, whose inverse is finite.
_TINY = 1e-12


class _Rays(NamedTuple):
    """Integrals of the likelihood over intervals of range, each in the direction of a draw."""

    draw: np.ndarray  # Index of the draw, int [R].
    direction: np.ndarray  # Unit vector, float64 [R, 3].
    log_mass: np.ndarray  # Logarithm of the integral, float64 [R]; -inf outside of the region.
    range_m: np.ndarray  # Mean range, float64 [R] [m].
    variance_m2: np.ndarray  # Variance of the range, float64 [R] [m^2].
    average: np.ndarray  # Mean log-likelihood, weighted by the likelihood, float64 [R].
    highest: np.ndarray  # Highest log-likelihood, float64 [R].


class DrawnPosterior:
    """The posterior of positions without nuisance parameters, computed from the table alone."""

    def __init__(self, scenario: Scenario, table: TemplateTable, n_measurements: int,
                 sampling: Sampling = SAMPLING) -> None:
        self._table, self._sampling, resolution = table, sampling, Resolution.of(scenario)
        self._n_measurements = n_measurements
        self._wavelength_m = resolution.wavelength_m
        # Rays have a length only in a region with a volume.
        low, high = resolution.bounds_m
        lacking_m = np.maximum(_MIN_THICKNESS * self._wavelength_m - (high - low), 0.0)
        self._bounds = bounds = np.stack([low - lacking_m / 2, high + lacking_m / 2])
        self._wavenumbers = carrier_wavenumbers(scenario)
        self._log_region = float(np.log(bounds[1] - bounds[0]).sum())
        grid, points = table.grid, table.grid.points
        # Directions of each cell that meet the region: lowest (u, v) and extent, float64 [C, 2].
        half_m = grid.widths_m[grid.range_bin, None] / 2
        sines = [bounds[:, None, 1:] / np.maximum(points[:, :1] + sign * half_m, half_m)
                 for sign in (-1, 1)]
        widest = np.minimum(*sines)[0], np.maximum(*sines)[1]
        lowest, highest = (points[:, 1:] + sign * PHASE_ERROR * resolution.direction
                           for sign in (-1, 1))
        self._low = np.maximum(lowest, widest[0])
        self._extent = np.maximum(np.minimum(highest, widest[1]) - self._low, 0.0)
        with np.errstate(divide='ignore'):
            self._log_area = np.log(self._extent).sum(axis=1)
        volume = points[:, 0]**2 * grid.widths_m[grid.range_bin] / _boresight(points[:, 1:])
        self._log_volume = np.log(volume) + self._log_area

    def draw(self, favoured: bool) -> Draw:
        """Return the draws of a search; if `favoured`, other surfaces may favour its modes."""
        sampling = self._sampling
        return Draw(sampling.largest_favoured if favoured else sampling.largest, self.fit)

    def fit(self, query: Query, shot: int) -> Fit | None:
        """Compute the posterior of a shot.

        Returns None if too few draws are effective, or the table limits signals.
        """
        if not self._table.filters.is_exact:
            return None
        sampling, n_draws = self._sampling, self._sampling.draws
        probability = bounds = self._probabilities(query, shot)
        cells, log_weights, parts, total_share = np.empty(0, int), np.empty(0), [], 0.0
        for n_rounds in range(1, sampling.rounds + 1):
            share = np.sqrt(n_rounds)
            total_share += share
            drawn = np.searchsorted(
                np.cumsum(probability), (np.arange(n_draws) + 0.5) / n_draws)
            places = (len(cells) + np.arange(n_draws))[:, None] * _SEQUENCE
            rays = self._rays(query, shot, drawn, places % 1)
            log_scale = np.log(share / (n_draws * probability[drawn]))
            log_weights = np.append(log_weights, rays.log_mass + log_scale[rays.draw])
            parts.append(rays._replace(draw=rays.draw + len(cells)))
            cells, rays = np.append(cells, drawn), concatenate(*parts)
            if np.isneginf(log_weights.max(initial=-np.inf)):
                return None
            weights, log_total = mixture_weights(log_weights)
            by_draw = np.bincount(rays.draw, weights, len(cells))
            variance = np.sum(by_draw**2)
            if variance <= 1 / sampling.effective:
                break
            found = np.bincount(cells, by_draw, len(bounds))
            probability = ((1 - sampling.share_of_bounds) * found
                           + sampling.share_of_bounds * bounds)
        else:
            return None
        places = rays.range_m[:, None] * rays.direction
        mean, covariance = moments(weights, places)
        along = weights * rays.variance_m2
        covariance += (along[:, None] * rays.direction).T @ rays.direction
        # The log-likelihoods of the rays omit the energy of the signals.
        energy, best = float(query.energies[shot]), float(rays.highest[weights > 0].max())
        log_evidence = float(log_total) - np.log(total_share) - energy - self._log_region
        return Fit(
            mean, regular(covariance * (1 + variance)), log_evidence, log_evidence,
            energy - best, self._n_measurements + float(weights @ rays.average) - best, 0.0,
            functools.partial(_described, rays, weights, 1 + variance, self._bounds))

    def _probabilities(self, query: Query, shot: int) -> np.ndarray:
        """Approximate each cell's share of the posterior, as if carrier phases were random."""
        # The average of exp(2 A cos(phase)) is nearly exp(2 A) / sqrt(1 + 4 pi A).
        n_bands, bound = len(self._wavenumbers), query.bound[shot]
        amplitude = (bound + self._table.cells.template_energy) / (2 * n_bands)
        value = self._sampling.power * (bound - n_bands / 2 * np.log1p(4 * np.pi * amplitude))
        value += self._log_volume
        shares: np.ndarray = np.exp(value - value.max(), dtype=float)
        return shares / shares.sum()

    def _rays(self, query: Query, shot: int, cells: np.ndarray, places: np.ndarray) -> _Rays:
        """Integrate along K directions, given by cells [K] and positions within them [K, 2]."""
        directions = np.empty((len(cells), 3))
        directions[:, 1:] = self._low[cells] + places * self._extent[cells]
        directions[:, 0] = _boresight(directions[:, 1:])
        windows = self._table.evaluate_windows(query, shot, cells, directions[:, 1:])
        amplitude = np.abs(windows.outputs).sum(axis=1)
        bound = 2 * amplitude - windows.energy
        best = int(np.argmax(bound))
        limit = bound[best] - np.log1p(4 * np.pi * amplitude[best]) / 2 - self._sampling.margin
        windows = select(windows, np.flatnonzero(bound >= limit))
        per_wavelength = max(self._sampling.steps, np.pi * np.sqrt(2 * amplitude[best]))
        n_steps = int(np.ceil(self._table.max_width_m / self._wavelength_m * per_wavelength))
        low, high = self._inside(directions)
        rows, n = windows.row, max(self._sampling.block // n_steps, 1)
        parts = [self._integrate(select(windows, slice(k, k + n)), low, high, n_steps)
                 for k in range(0, len(rows), n)]
        log_mass, *moments = (np.concatenate(fields) for fields in zip(*parts, strict=True))
        log_mass += (self._log_area[cells] - np.log(directions[:, 0]))[rows]
        return _Rays(rows, directions[rows], log_mass, *moments)

    def _integrate(self, windows: Windows, low: np.ndarray, high: np.ndarray, n_steps: int
                   ) -> tuple[np.ndarray, ...]:
        """Integrate over windows from `low` to `high` [m]; return the last five `_Rays` fields."""
        step_m, range_m = self._table.max_width_m / n_steps, windows.range_m
        offsets_m = ((np.arange(n_steps) - (n_steps - 1) / 2) * step_m).astype(np.float32)
        turns = np.exp(1j * self._wavenumbers[:, None] * offsets_m)
        rotation = (2 * np.concatenate([turns.real, -turns.imag])).astype(np.float32)
        outputs = windows.outputs
        value = np.hstack([outputs.real, outputs.imag]) @ rotation
        value -= windows.energy[:, None]
        highest = value.max(axis=1)
        value -= highest[:, None]
        density = np.exp(value)
        nearest = np.maximum(low[windows.row] - range_m, -windows.width_m / 2)
        farthest = np.minimum(high[windows.row] - range_m, windows.width_m / 2)
        # Part of each step that is inside.
        ends_m = np.stack([nearest, farthest], axis=1)[..., None].astype(np.float32)
        share = np.clip((ends_m - offsets_m) / np.float32(step_m), -0.5, 0.5)
        density *= np.maximum(share[:, 1] - share[:, 0], 0)
        moments = (density @ np.stack([np.ones_like(offsets_m), offsets_m, offsets_m**2], axis=1)
                   ).astype(float)
        mass = np.maximum(moments[:, 0], np.finfo(np.float32).tiny)
        mean, square = moments[:, 1] / mass, moments[:, 2] / mass
        average = highest + np.einsum('wn,wn->w', density, value) / mass
        log_mass = highest + np.log(mass * step_m * range_m**2)
        log_mass[moments[:, 0] == 0] = -np.inf
        return (log_mass, range_m + mean, np.maximum(square - mean**2, 0.0), average, highest)

    def _inside(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ranges at which directions [K, 3] enter and leave the region, [K] [m]."""
        directions = np.where(np.abs(directions) < _TINY, _TINY, directions)
        ends = np.sort(self._bounds[:, None] / directions, axis=0)
        return ends[0].max(axis=1), ends[1].min(axis=1)


def _described(rays: _Rays, weights: np.ndarray, widening: float, bounds: np.ndarray
               ) -> tuple[Mixture, Sheets]:
    """Return the posterior as a mixture, and the likelihood, of groups of rays."""
    chosen = weights > weights.max() * SAMPLING.least
    rays, weights = select(rays, chosen), weights[chosen]
    places = rays.range_m[:, None] * rays.direction
    shares = _groups(weights, places)
    log_shares, shares = np.log(shares.sum(axis=1)), shares / shares.sum(axis=1, keepdims=True)
    along = np.zeros((len(weights), 3))
    along[:, 0] = 1.0

    def of_each(points: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        means = shares @ points
        outer = points[:, :, None] * points[:, None] + (
            rays.variance_m2[:, None, None] * axis[:, :, None] * axis[:, None])
        squares = (shares @ outer.reshape(-1, 9)).reshape(-1, 3, 3)
        return means, squares - means[:, :, None] * means[:, None]

    means, covariances = of_each(places, rays.direction)
    points, bent = of_each(np.column_stack([rays.range_m, rays.direction[:, 1:]]), along)
    # A few rays have moments in fewer dimensions than the posterior around them. All groups
    # together show how wide it is.
    variance = float(np.exp(log_shares) @ np.trace(bent[:, 1:, 1:], axis1=1, axis2=2)) / 2
    few = np.sum(shares**2, axis=1)**2
    bent[:, 1:, 1:] += (few * variance / np.exp(log_shares).sum())[:, None, None] * np.eye(2)
    return (Mixture._make((log_shares, means, regular(covariances))).normalised().scaled(widening),
            Sheets.of_density(log_shares, points, bent, bounds))


def _groups(weights: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the weights of places [P, 3] in each of G groups, float64 [G, P].

    Each group is divided again and again at its mean, along the axis in which it is widest.
    """
    group, row = np.zeros(len(weights), int), np.arange(len(weights))
    for _ in range(SAMPLING.levels):
        total, *sums = (np.bincount(group, weights * values) for values in (1.0, *places.T))
        means = np.stack(sums, axis=1) / np.maximum(total, np.finfo(float).tiny)[:, None]
        offsets = places - means[group]
        squares = np.stack([np.bincount(group, weights * one**2) for one in offsets.T])
        beyond = offsets[row, np.argmax(squares, axis=0)[group]] > 0
        group = 2 * group + (beyond & (np.bincount(group) >= SAMPLING.divided)[group])
    return weights * np.equal.outer(np.unique(group), group)


def _boresight(directions: np.ndarray) -> np.ndarray:
    """Return the cosine of the angle from boresight for (u, v) [K, 2]; at least 1e-6."""
    return np.sqrt(np.maximum(1 - np.sum(directions**2, axis=1), 1e-12))
