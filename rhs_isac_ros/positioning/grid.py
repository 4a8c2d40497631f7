"""The search for modes of the likelihood on a polar grid of templates over the region of interest.

A template is a whitened mean without its carrier: exp(i k_i r) t_i(p) changes slowly with the
range, so that a coarse grid suffices. The log-likelihood at range steps that resolve the carrier
follows from one complex number per band and grid point: the fine range steps rotate the phase of
the matched filter's output.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, MeasurementModel, Scenario
from rhs_isac_ros.model.threads import map_blocks
from rhs_isac_ros.positioning.coordinates import (
    carrier_wavenumbers,
    is_inside,
    jacobian,
    likelihood_loss,
    offset_to_roi,
    to_polar,
    to_positions,
)
from rhs_isac_ros.positioning.likelihood import MIN_CURVATURE, NuisancePrior

# Cells of the grid in range and direction cosines.
RANGE_CELL_M = 0.5
DIRECTION_STEP = 0.025
# Number of points that represent a standard Gaussian.
_N_NORMAL = 128
# Number of grid points to compute at a time.
_BLOCK = 256
# Largest sine of the angle from boresight on the grid.
_MAX_SINE = 0.995
# Number of positions along each edge of the region that determine the extent of the grid.
_N_EDGE = 33
# Fine range steps per shortest wavelength; at least four are needed to resolve the posterior.
STEPS_PER_WAVELENGTH = 8
# Number of phases to search at a time.
_N_PHASES = 32
# Peaks closer than an ellipsoid of these radii in (r in wavelengths, u, v) are one mode; in metres
# of range if the phases of the bands carry no information.
_MIN_SEPARATION = (0.37, 0.062, 0.062)
_MIN_COARSE_SEPARATION_M = 0.75
# Number of points to compare with each other at a time.
_N_COMPARED = 64
_EARLIER = np.tri(_N_COMPARED, k=-1, dtype=bool)
# Error of a mode's log-likelihood due to the grid, as a share of the template's energy.
_GRID_ERROR = 0.05
# The linear model does not hold for longer steps.
_STEP_LIMITS = np.array([0.02, 0.03, 0.03])


class Effort(NamedTuple):
    """Numbers of grid points and of peaks along their range that a search examines closely."""

    cells: int
    peaks: int
    modes: int


# Nuisance parameters lower all peaks towards each other.
_EFFORTS = {False: Effort(256, 256, 32), True: Effort(1024, 768, 96)}


def tabulate(model: MeasurementModel) -> dict[str, np.ndarray]:
    """Compute the templates of a scenario and codebook.

    Returns
    -------
    dict of numpy.ndarray
        By name, for G grid points: ``points`` (r [m], u, v), float64 [G, 3]; ``filters``, the
        conjugate templates, complex64 [N_B, G, N_SB F]; ``slope_filters``, the conjugate
        derivatives of the templates with respect to the point, complex64 [N_B, G, 3, N_SB F];
        ``energy`` of the templates, float32 [G]; ``energy_slope``, its derivative, float64
        [G, 3]; ``curvature`` of the log-likelihood, float64 [G, 3, 3]; and, independent of the
        codebook, ``normal``, points that represent a standard Gaussian, float64 [128, 3].
    """
    points = polar_grid(model.scenario)
    n, (n_bands, n_rows) = len(points), model.shape
    table = {
        'points': points,
        'filters': np.empty((n_bands, n, n_rows), np.complex64),
        'slope_filters': np.empty((n_bands, n, 3, n_rows), np.complex64),
        'energy': np.empty(n, np.float32),
        'energy_slope': np.empty((n, 3)),
        'curvature': np.empty((n, 3, 3)),
        'normal': standard_normal(_N_NORMAL),
    }
    wavenumbers = carrier_wavenumbers(model.scenario)

    def fill(start: int) -> None:
        block = slice(start, start + _BLOCK)
        mean, by_position = model.mean_and_jacobian(to_positions(points[block]), whitened=True)
        by_point = np.matmul(
            np.swapaxes(jacobian(points[block]), 1, 2), by_position.reshape(len(mean), 3, -1))
        carrier = np.exp(1j * wavenumbers * points[block, :1])[..., None]
        table['filters'][:, block] = np.swapaxes(mean * carrier, 0, 1).conj()
        slopes = by_point.reshape(by_position.shape) * carrier[:, None]
        table['slope_filters'][:, block] = np.moveaxis(slopes, 2, 0).conj()
        flat = mean.reshape(len(mean), -1)
        table['energy'][block] = np.sum(np.abs(flat)**2, axis=1)
        table['energy_slope'][block] = 2 * np.matmul(by_point.conj(), flat[..., None])[..., 0].real
        table['curvature'][block] = quadratic_form(by_point)

    map_blocks(fill, range(0, n, _BLOCK))
    return table


def standard_normal(n: int) -> np.ndarray:
    """Return points that represent a standard Gaussian, float64 [n, 3], for a power of two."""
    # The points are kept with the table because these imports take longer than loading a table.
    from scipy.special import ndtri
    from scipy.stats import qmc

    result: np.ndarray = ndtri(np.clip(qmc.Sobol(3, seed=0).random(n), 1e-6, 1 - 1e-6))
    return result


def polar_grid(scenario: Scenario) -> np.ndarray:
    """Return a grid whose cells cover the region of interest, (r [m], u, v), float64 [G, 3]."""
    low, high = scenario.roi_bounds_m
    edges = [np.linspace(low[u], high[u], _N_EDGE) for u in range(3)]
    extent = to_polar(np.stack(np.meshgrid(*edges, indexing='ij'), axis=-1).reshape(-1, 3))
    steps = (RANGE_CELL_M, DIRECTION_STEP, DIRECTION_STEP)
    lines = [np.arange(np.floor(extent[:, a].min() / steps[a]),
                       np.ceil(extent[:, a].max() / steps[a]) + 1) * steps[a] for a in range(3)]
    # The direction is undefined at range 0; the first cell is centred a quarter cell further out.
    lines[0] = np.where(lines[0] > 0, lines[0], RANGE_CELL_M / 4)
    points = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 3)
    # Directions slightly beyond the rim of the half space are moved onto it.
    excess = np.maximum(np.hypot(points[:, 1], points[:, 2]) / _MAX_SINE, 1.0)
    near = excess < 1 + 2 * DIRECTION_STEP
    points = points[near]
    points[:, 1:] /= excess[near, None]
    # A cell belongs to the grid if the bounding box of its corners intersects the region.
    halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    corners = to_positions(points[:, None] + halves * steps)
    intersects = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
    result: np.ndarray = points[intersects.all(axis=1)]
    return result


class TemplateTable:
    """Fast evaluation of the log-likelihood over the whole region of interest.

    Parameters
    ----------
    arrays
        The arrays that `tabulate` returns for the scenario and a codebook.

    Attributes
    ----------
    points
        Grid (r [m], u, v), float64 [G, 3].
    range_offsets_m
        Fine range steps, relative to the range of a grid point, float64 [D] [m].
    normal
        Points that represent a standard Gaussian, float64 [128, 3].
    wavelength_m
        Shortest wavelength of the bands' centres [m].
    filters
        Conjugate templates without their carrier, complex64 [N_B, G, N_SB F].
    """

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray]) -> None:
        self.points, self.normal = arrays['points'], arrays['normal']
        self.filters, self._slope_filters = arrays['filters'], arrays['slope_filters']
        self._energy, self._energy_slope = arrays['energy'], arrays['energy_slope']
        self._curvature = arrays['curvature'] + np.diag(MIN_CURVATURE)
        self._inverse = np.linalg.inv(self._curvature)
        self._bounds = scenario.roi_bounds_m
        self.wavelength_m = SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz)
        n_fine = int(np.ceil(RANGE_CELL_M / self.wavelength_m * STEPS_PER_WAVELENGTH))
        self.range_offsets_m = ((np.arange(n_fine) + 0.5) / n_fine - 0.5) * RANGE_CELL_M
        wavenumbers = carrier_wavenumbers(scenario)
        self._carrier = np.exp(
            1j * wavenumbers[:, None] * self.points[:, 0]).astype(np.complex64)
        phase = np.exp(1j * wavenumbers * self.range_offsets_m[:, None])
        self._rotation = (2 * np.hstack([phase.real, -phase.imag])).astype(np.float32)
        self._fine = np.ascontiguousarray(phase.T.astype(np.complex64))

    def log_likelihood(self, whitened: np.ndarray) -> np.ndarray:
        """Compute the log-likelihood on the fine grid, up to a constant, float32 [G, D].

        The whitened signals are those of one positioning phase, complex128 [N_B, N_SB F], without
        nuisance parameters.
        """
        signals = whitened.astype(np.complex64)
        outputs = np.matmul(self.filters, signals[..., None])[..., 0] * self._carrier
        result: np.ndarray = (self._rotation @ np.concatenate([outputs.real, outputs.imag])).T \
            - self._energy[:, None]
        return result

    def starts(self, whitened: np.ndarray, prior: NuisancePrior, margin: float) -> 'Starts':
        """Find the most likely separate points, to the accuracy of one Gauss-Newton step.

        Those of a phase do not depend on the other phases.

        Parameters
        ----------
        whitened
            Signals of N phases, complex128 [N, N_B, N_SB F], without the offsets of carrier and
            timing.
        prior
            The nuisance parameters.
        margin
            The log-likelihood of a point may be lower than the best by up to this plus the error
            of the grid.
        """
        parts = []
        for start in range(0, len(whitened), _N_PHASES):
            part = self._starts(whitened[start:start + _N_PHASES], prior, margin)
            parts.append(part._replace(phases=part.phases + start))
        return parts[0] if len(parts) == 1 else Starts(
            *(np.concatenate(fields) for fields in zip(*parts, strict=True)))

    def starts_under(self, whitened: np.ndarray, prior: NuisancePrior, factor: np.ndarray,
                     max_points: int) -> 'Starts':
        """Find the highest separate points of the grid for another covariance of the signals.

        Parameters
        ----------
        whitened
            Signals of one phase, whitened as the templates, complex128 [N_B, N_SB F].
        factor
            F of the inverse F F^H of the other covariance after this whitening, complex128
            [N_B, N_SB F, N_SB F].
        """
        turned = np.matmul(self.filters, factor.astype(np.complex64))
        energy = np.sum(turned.real**2 + turned.imag**2, axis=(0, 2))
        signals = np.einsum('bsr,bs->br', factor.conj(), whitened).astype(np.complex64)
        outputs = np.matmul(turned, signals[..., None])[..., 0] * self._carrier
        effort = _EFFORTS[len(prior) > 0]
        cells = _highest(2 * np.abs(outputs).sum(axis=0)[None] - energy, effort.cells)
        peaks = self._peaks(
            outputs[:, cells[0]][None], energy[cells], np.array([np.sum(np.abs(signals)**2)]),
            prior, effort.peaks)
        points, values = self._at(cells, peaks, prior)
        order = np.argsort(-peaks.value, axis=1)[:, :np.isfinite(peaks.value).sum()]
        points, values = points[0, order], values[0, order[0]]
        chosen = suppress(_closer_than_one(points / self._separation(prior)),
                          np.ones(order.shape, bool), max_points)[0]
        return Starts(np.zeros(chosen.sum(), int), points[0, chosen], values[chosen])

    def _starts(self, whitened: np.ndarray, prior: NuisancePrior, margin: float) -> 'Starts':
        effort = _EFFORTS[len(prior) > 0]
        signals = whitened.astype(np.complex64)
        cells, outputs = self._best_cells(signals, effort.cells)
        peaks = self._peaks(outputs, self._energy[cells], np.sum(np.abs(whitened)**2, axis=(1, 2)),
                            prior, effort.peaks)
        cell, value = np.take_along_axis(cells, peaks.cell, axis=1), peaks.value
        points, values = self._at(cells, peaks, prior)
        if not prior.is_coarse:
            step, rise = self._step(cells, cell, signals, peaks, prior, values)
            points, value = points + step, value + rise
        value = value - self._loss_outside(points, cell, value, margin)
        order = np.argsort(-value, axis=1)
        value = np.take_along_axis(value, order, axis=1)
        best = np.take_along_axis(cell, order[:, :1], axis=1)
        valid = value >= value[:, :1] - margin - _GRID_ERROR * self._energy[best]
        order, rows = order[:, :valid.sum(axis=1).max()], np.arange(len(cell))[:, None]
        points, values = points[rows, order], values[rows, order]
        chosen = suppress(_closer_than_one(points / self._separation(prior)),
                          valid[:, :order.shape[1]], effort.modes)
        return Starts(np.nonzero(chosen)[0], points[chosen], values[chosen])

    def _at(self, cells: np.ndarray, peaks: '_Peaks', prior: NuisancePrior
            ) -> tuple[np.ndarray, np.ndarray]:
        """Points of peaks, float64 [N, P, 3], and nuisance parameters there, [N, P, Q]."""
        points = self.points[np.take_along_axis(cells, peaks.cell, axis=1)]
        points[..., 0] += self._offsets(prior)[peaks.fine]
        values = np.zeros((*peaks.cell.shape, len(prior)))
        if len(prior):
            outputs = np.moveaxis(peaks.outputs, 1, 0)
            values = prior.start(
                outputs.reshape(len(outputs), -1), peaks.gain.ravel()).reshape(values.shape)
        return points, values

    def _step(self, cells: np.ndarray, cell: np.ndarray, signals: np.ndarray, peaks: '_Peaks',
              prior: NuisancePrior, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton steps [n, P, 3] from peaks, and the predicted rise of the likelihood.

        Between grid points, a sharp mode is much higher.
        """
        slopes = self._products(self._slope_filters, cells, signals)
        slopes = np.take_along_axis(slopes, peaks.cell[:, None, :, None], axis=2)
        phase = np.moveaxis(self._carrier[:, cell] * self._fine[:, peaks.fine], 0, 1)
        if len(prior):
            phase = phase * np.moveaxis(np.exp(
                -1j * (values @ prior.phases.T) - peaks.gain[..., None]), 2, 1)
        gradient = 2 * np.sum(slopes * phase[..., None], axis=1).real - self._energy_slope[cell]
        step = np.einsum('npij,npj->npi', self._inverse[cell], gradient)
        return (np.clip(step, -_STEP_LIMITS, _STEP_LIMITS),
                np.sum(gradient * step, axis=2) / 2)

    def _best_cells(self, signals: np.ndarray, n_cells: int) -> tuple[np.ndarray, np.ndarray]:
        """Grid points with the highest bounds of the log-likelihood, and the outputs there.

        Takes complex64 [N, N_B, N_SB F]; returns int [N, C] and complex64 [N, N_B, C].
        """
        outputs = np.matmul(np.swapaxes(signals, 0, 1), np.swapaxes(self.filters, 1, 2))
        # Along the range, the log-likelihood is at most that of outputs in phase.
        highest = np.abs(outputs).sum(axis=0)
        highest *= 2
        highest -= self._energy
        cells = _highest(highest, n_cells)
        # Products of equal sizes round the same, whatever the number of phases.
        products = self._products(self.filters[:, :, None], cells, signals)[..., 0]
        return cells, products * np.moveaxis(self._carrier[:, cells], 0, 1)

    def _products(
            self, filters: np.ndarray, cells: np.ndarray, signals: np.ndarray) -> np.ndarray:
        """Products of filters [N_B, G, Q, N_SB F] with signals, complex64 [N, N_B, C, Q]."""
        (n, n_cells), (n_bands, _, *shape) = cells.shape, filters.shape
        products = np.empty((n, n_bands, n_cells * shape[0], 1), np.complex64)
        # One buffer for all phases remains in the cache.
        gathered = np.empty((n_bands, n_cells, *shape), np.complex64)
        rows = gathered.reshape(n_bands, -1, shape[1])
        for chosen, phase, result in zip(cells, signals[..., None], products, strict=True):
            for band, target in enumerate(gathered):
                # The mode without checks needs no copy of the result.
                filters[band].take(chosen, axis=0, out=target, mode='clip')
            np.matmul(rows, phase, out=result)
        return products.reshape(n, n_bands, n_cells, -1)

    def _peaks(self, outputs: np.ndarray, energy: np.ndarray, signal_energy: np.ndarray,
               prior: NuisancePrior, n_peaks: int) -> '_Peaks':
        """Find the highest peaks along the range among the grid points of each phase.

        Takes outputs [N, N_B, C], energies of the templates [N, C] and of the signals [N].
        """
        fine = np.ones_like(self._fine[:, :1]) if prior.is_coarse else self._fine
        if prior.phase_covariance.any():
            doubled = 2 * np.stack([
                prior.amplitude(fine[..., None] * one[:, None])
                for one in outputs])
        else:
            doubled = np.matmul(
                self._rotation, np.concatenate([outputs.real, outputs.imag], axis=1))
        gain = np.zeros(doubled.shape) if prior.gain_std else None
        if gain is not None:
            n_rows = self.filters.shape[0] * self.filters.shape[2]
            for one, its_gain, its_energy in zip(doubled, gain, signal_energy, strict=True):
                one[...], its_gain[...] = prior.over_gain(one / 2, float(its_energy), n_rows)
        likelihood = doubled - energy[:, None]
        rising = likelihood[:, 1:] >= likelihood[:, :-1]
        falling = likelihood[:, 1:] <= likelihood[:, :-1]
        peak = np.ones(likelihood.shape, bool)
        peak[:, 1:] &= rising
        peak[:, :-1] &= falling
        place = np.zeros((len(outputs), n_peaks), int)
        value = np.full(place.shape, -np.inf, np.float32)
        for row, (are_peaks, flat) in enumerate(zip(
                peak.reshape(len(peak), -1), likelihood.reshape(len(peak), -1), strict=True)):
            found = np.flatnonzero(are_peaks)
            if len(found) > n_peaks:
                found = found[np.sort(np.argpartition(flat[found], -n_peaks)[-n_peaks:])]
            place[row, :len(found)] = found
            value[row, :len(found)] = flat[found]
        fine_index, index = np.divmod(place, outputs.shape[2])
        at_peak = outputs[:, :, :0]
        if len(prior):
            at_peak = np.take_along_axis(outputs, index[:, None], axis=2)
            at_peak = at_peak * np.moveaxis(fine[:, fine_index], 0, 1)
        at_gain = (np.zeros(place.shape) if gain is None else
                   np.take_along_axis(gain.reshape(len(gain), -1), place, axis=1))
        return _Peaks(index, fine_index, value, at_gain, at_peak)

    def _offsets(self, prior: NuisancePrior) -> np.ndarray:
        """Range steps [m]: a single one if the phases carry no information about the range."""
        return np.zeros(1) if prior.is_coarse else self.range_offsets_m

    def _separation(self, prior: NuisancePrior) -> np.ndarray:
        """Radii of the ellipsoid in (r [m], u, v) that contains one mode."""
        separation = np.array(_MIN_SEPARATION) * (self.wavelength_m, 1, 1)
        if prior.is_coarse:
            separation[0] = _MIN_COARSE_SEPARATION_M
        return separation

    def _loss_outside(self, points: np.ndarray, cell: np.ndarray, value: np.ndarray,
                      margin: float) -> np.ndarray:
        """Loss of log-likelihood from points to the region, [N, P]: 0 inside.

        The loss is infinite for points that are too unlikely even without it.
        """
        inside = is_inside(to_positions(points), self._bounds)
        result = np.where(inside, 0.0, np.inf)
        values = np.where(inside, value, -np.inf)
        best, rows = values.argmax(axis=1)[:, None], np.arange(len(cell))[:, None]
        limit = values[rows, best] - margin - _GRID_ERROR * self._energy[cell[rows, best]]
        outside = ~inside & (value >= limit)
        if outside.any():
            curvature = self._curvature[cell[outside]]
            offset = offset_to_roi(points[outside], curvature, self._bounds)
            result[outside] = likelihood_loss(offset, curvature)
        return result


class Starts(NamedTuple):
    """Points from which a search ascends to the modes of N phases.

    Attributes
    ----------
    phases
        Phase of each point, int [M], ascending; those of a phase start with the most likely.
    points
        (r [m], u, v), float64 [M, 3].
    values
        Nuisance parameters, float64 [M, Q].
    """

    phases: np.ndarray
    points: np.ndarray
    values: np.ndarray


class _Peaks(NamedTuple):
    """P peaks along the range for each of N phases.

    Attributes
    ----------
    cell, fine
        Index of the grid point among those examined, and of the range step, int [N, P].
    value
        Log-likelihood, float32 [N, P]; -inf where there is no further peak.
    gain
        Most likely gain [nepers], float64 [N, P].
    outputs
        Outputs of the bands' matched filters, complex64 [N, N_B, P]; none without nuisance
        parameters.
    """

    cell: np.ndarray
    fine: np.ndarray
    value: np.ndarray
    gain: np.ndarray
    outputs: np.ndarray


# Whether points of some index are close to others: takes int [L, A] and [L, B], returns bool
# [L, A, B].
Closeness: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]


def suppress(are_close: Closeness, valid: np.ndarray, max_points: int) -> np.ndarray:
    """Suppress points that are close to a better one which remains, bool [L, N].

    Parameters
    ----------
    are_close
        Closeness of points, in L lists of N points, the best first. Indices of one list apply to
        all lists.
    valid
        Which points belong to the lists, bool [L, N].
    max_points
        Largest number of points that remain of a list.
    """
    n_lists, n = valid.shape
    rows, every = np.arange(n_lists)[:, None], np.arange(n)[None]
    chosen, kept = np.zeros(valid.shape, bool), np.zeros((n_lists, 0), int)
    for start in range(0, n, _N_COMPARED):
        end = min(start + _N_COMPARED, n)
        block, free = every[:, start:end], valid[:, start:end]
        if start:
            free = free & ~(are_close(block, kept) & chosen[rows, kept][:, None]).any(axis=2)
        before = are_close(block, block) & _EARLIER[:end - start, :end - start]
        # Each round settles at least one more point, because only earlier ones matter; a few
        # suffice.
        remaining, previous = free, np.zeros_like(free)
        while (remaining != previous).any():
            remaining, previous = free & ~(before & remaining[:, None]).any(axis=2), remaining
        chosen[:, start:end] = remaining
        counts = chosen.sum(axis=1)
        if end == n or (counts >= max_points).all():
            break
        kept = np.argsort(~chosen[:, :end], axis=1, kind='stable')[:, :counts.max()]
    return chosen & (np.cumsum(chosen, axis=1) <= max_points)


def _closer_than_one(points: np.ndarray) -> Closeness:
    """Return whether points [L, N, 3] are closer than 1."""
    rows = np.arange(len(points))[:, None]
    # Small coordinates leave more digits to single precision.
    points = (points - points.mean(axis=(0, 1))).astype(np.float32)
    squares = np.einsum('lnu,lnu->ln', points, points)

    def are_close(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        distance = np.matmul(points[rows, first], np.swapaxes(-2 * points[rows, second], 1, 2))
        distance += squares[rows, first][:, :, None]
        distance += squares[rows, second][:, None]
        close: np.ndarray = distance < 1
        return close

    return are_close


def _highest(bounds: np.ndarray, n_cells: int) -> np.ndarray:
    """Indices of the cells with the highest bounds [N, G], ascending, int [N, C]."""
    n_cells = min(n_cells, bounds.shape[1])
    return np.sort(np.argpartition(bounds, -n_cells, axis=1)[:, -n_cells:], axis=1)
