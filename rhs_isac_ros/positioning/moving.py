"""The search for users who move during a cycle, over templates of users who stand still.

In polar coordinates, a frame of a user who moves is the template of another direction, turned by
the change of the range. For each direction and each hypothesis of its rates, the frames of a band
are therefore added up with phases that grow with the time: a transform over the radial speed. The
phases of the bands are unknown, and the range follows from the amplitude. The best combinations
are the starts of the ascent, which moves position and velocity together.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import adjoint
from rhs_isac_ros.model.geometry import frame_times_s
from rhs_isac_ros.positioning.estimate import Fit
from rhs_isac_ros.positioning.grid import Draw, Starts, TemplateTable, separate
from rhs_isac_ros.positioning.lattice import PHASE_ERROR, Grid
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.segments import concatenate
from rhs_isac_ros.positioning.templates import turns_at

# Largest radial speed and largest speed across the line of sight, in standard deviations.
_RADIAL = 3.5
_ACROSS = 2.0
# Number of candidates from each hypothesis of the rates, number of starts of a shot, and largest
# deficit of their log-likelihoods.
_CANDIDATES = 128
_STARTS = 80
_MARGIN = 90.0
# Largest ratio of successive ranges of starts with an unknown gain, from which the ascent reaches
# those between them.
_RATIO = 1.3


class _Shell(NamedTuple):
    """Templates of one range, and the ranges and rates for which they are used."""

    nodes: slice
    ranges_m: np.ndarray  # Ranges whose delays represent those of the shell, float64 [R].
    # Nearest and farthest range of users with such a delay in the direction of a template, where
    # the second one is larger, float64 [R, G].
    nearest_m: np.ndarray
    farthest_m: np.ndarray
    rates: np.ndarray  # Hypotheses of the rates of u and v, float64 [H, 2] [1/s].
    # Index of the template of each frame for each hypothesis, int [H, N_B, G, F], and the offset
    # of its direction from that of the frame, float32 [H, 2, N_B, G, F].
    nearest: np.ndarray
    offset: np.ndarray
    # Squared speeds across the line of sight relative to the range, float64 [H, G] [1/s^2], and
    # phases of the frames because the range grows with the square of the time, [H, N_B, G, F].
    squares: np.ndarray
    bend: np.ndarray
    # Inverses of the energies for each hypothesis and V radial speeds, times the squared range,
    # float32 [H, R, G, V].
    inverse: np.ndarray

    def frames(self, hypothesis: int, band: int, stack: np.ndarray) -> np.ndarray:
        """Take values of the frames of a band, [K, G, F], from templates and slopes in u and v.

        `stack`, complex64 [3, K, G, F], contains these for all templates.
        """
        index = self.nearest[hypothesis, band]
        value, *slopes = np.take_along_axis(stack, index[None, None], axis=2)
        for slope, offset in zip(slopes, self.offset[hypothesis, :, band], strict=True):
            value = value + offset * slope
        return value * self.bend[hypothesis, band]


class MovingTable(TemplateTable):
    """A `TemplateTable` whose search assumes that users move with the declared velocities."""

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray],
                 grid: Grid | None = None) -> None:
        super().__init__(scenario, arrays, grid)
        self._times_s, self._std = frame_times_s(scenario), scenario.user_speed_std_mps
        self._steps = self._resolution.rate_steps
        n = round(_RADIAL * self._std / self._steps[0])
        self._speeds = np.arange(-n, n + 1) * self._steps[0]
        # Phases that add up the frames of a user with each radial speed, [N_B, F, V].
        self._ramps = np.exp(1j * (self._carriers[:, None] * self._times_s)[..., None]
                             * self._speeds).astype(np.complex64)
        self._penalty = ((self._speeds / self._std)**2 / 2).astype(np.float32)
        self._shells = [self._shell(*one) for one in self.grid.shells]

    def _shell(self, nodes: slice, bins: slice, cells: slice) -> _Shell:
        from scipy.spatial import cKDTree

        grid, resolution = self.grid, self._resolution
        lowest, highest = (grid.ranges_m + sign * grid.widths_m / 2 for sign in (-1, 1))
        low, high = float(lowest[bins.start]), float(highest[bins.stop - 1])
        n_ranges = int(np.ceil((high - low) / (2 * PHASE_ERROR * resolution.delay_m)))
        edges_m = np.linspace(low, high, n_ranges + 1)[:, None]
        ranges_m = (edges_m[1:, 0] + edges_m[:-1, 0]) / 2
        # In each direction, part of the ranges is in the region.
        node, range_bin = grid.node[cells] - nodes.start, grid.range_bin[cells]
        first, last = (np.full(nodes.stop - nodes.start, sign * np.inf) for sign in (1, -1))
        np.minimum.at(first, node, lowest[range_bin])
        np.maximum.at(last, node, highest[range_bin])
        counts = np.round(_ACROSS * self._std / (low * self._steps[1:])).astype(int)
        rates = np.stack(np.meshgrid(*(
            np.arange(-n, n + 1) * step for n, step in zip(counts, self._steps[1:], strict=True)
        ), indexing='ij'), axis=-1).reshape(-1, 2)
        directions = grid.nodes[nodes, 1:]
        ends = directions[:, None] + self._times_s[:, None, :, None] * rates[:, None, None, None]
        scale = 1 / resolution.direction
        _, index = cKDTree(directions * scale).query(ends * scale)
        offset = np.moveaxis(ends - directions[index], -1, 1).astype(np.float32)
        squares = np.sum(rates**2, axis=1, keepdims=True) + (rates @ directions.T)**2 / np.maximum(
            1 - np.sum(directions**2, axis=1), 0.1)
        growth_m = (low + high) / 4 * squares[:, None, :, None] * self._times_s[:, None]**2
        bend = np.exp(1j * self._carriers[:, None, None] * growth_m).astype(np.complex64)
        shell = _Shell(
            nodes, ranges_m, np.maximum(edges_m[:-1], first), np.minimum(edges_m[1:], last),
            rates, index, offset, squares, bend, np.zeros(0))
        energy = np.stack([[self._energy(shell, hypothesis, range_m) for range_m in ranges_m]
                           for hypothesis in range(len(rates))])
        return shell._replace(inverse=1 / np.maximum(energy, np.finfo(np.float32).tiny))

    def _stack(self, shell: _Shell) -> np.ndarray:
        """Return templates and their slopes in u and v, complex64 [N_B, 3, N_SB, G, F]."""
        filters, nodes = self.filters, shell.nodes
        return np.stack([filters.templates[:, :, nodes], *(
            filters.slopes[:, :, nodes, axis] for axis in (1, 2))], axis=1)

    def _energy(self, shell: _Shell, hypothesis: int, range_m: float) -> np.ndarray:
        """Compute the energies for delays of a range, float32 [G, V]."""
        turns = np.conj(turns_at(self._wavenumbers, np.array([range_m])) * range_m)
        total = np.zeros((shell.nodes.stop - shell.nodes.start, len(self._speeds)), np.float32)
        for band, (stack, turn, whitener, ramps) in enumerate(zip(
                self._stack(shell), turns, self.filters.whitener, self._ramps, strict=True)):
            templates = shell.frames(hypothesis, band, stack).conj()
            n_subbands, n_nodes, n_frames = templates.shape
            means = np.moveaxis(templates * turn[..., None], 2, 0)
            weights = (adjoint(whitener) @ whitener).reshape(
                n_subbands, n_frames, n_subbands, n_frames).transpose(1, 3, 2, 0)
            # Products of two frames count twice.
            for frame, weight in enumerate(weights):
                columns = np.matmul(np.swapaxes(means[frame:], 1, 2), weight[frame:])
                products = np.einsum('sg,pgs->gp', means[frame].conj(), columns)
                products[:, 1:] *= 2
                total += (products.astype(np.complex64) @ (
                    ramps[frame] * ramps[frame:].conj())).real
        return total

    def search(self, whitened: np.ndarray, prior: NuisancePrior, margin: float | np.ndarray,
               draw: Draw | None = None) -> tuple[Starts, dict[int, Fit]]:
        """Find the most likely separate positions and velocities; see `TemplateTable.search`."""
        signals, _, energies = self.filters.apply(whitened)
        found = [self._starts_of(one, energy, prior, shot) for shot, (one, energy) in enumerate(
            zip(signals, energies.tolist(), strict=True))]
        return concatenate(*found), {}

    def _starts_of(self, signals: np.ndarray, energy: float, prior: NuisancePrior, shot: int
                   ) -> Starts:
        parts = [self._candidates(shell, hypothesis, filtered, energy, signals.size, prior)
                 for shell in self._shells
                 for filtered in [self._filtered(shell, signals)]
                 for hypothesis in range(len(shell.rates))]
        value, points, rates, gains, outputs = map(np.concatenate, zip(*parts, strict=True))
        order = np.argsort(-value, kind='stable')
        order = order[value[order] >= value[order[0]] - _MARGIN]
        radii = np.concatenate([self._resolution.separation(prior.is_coarse), self._steps])
        places = np.hstack([points, rates])[order]
        order = order[separate(np.zeros(len(order), int), places, radii)][:_STARTS]
        values = prior.with_rates(
            prior.start(outputs[order].T, gains[order]), points[order], rates[order])
        return Starts(np.full(len(order), shot), points[order], values)

    def _filtered(self, shell: _Shell, signals: np.ndarray) -> np.ndarray:
        """Filter the frames, [N_B, N_SB, F], for each range and `_stack`, [N_B, 3, R, G, F]."""
        turns = turns_at(self._wavenumbers, shell.ranges_m) * shell.ranges_m
        by_subband = self._stack(shell) * signals[:, None, :, None]
        shape = by_subband.shape
        filtered = np.matmul(np.swapaxes(turns, 1, 2)[:, None].astype(np.complex64),
                             by_subband.reshape(*shape[:3], -1))
        return filtered.reshape(*shape[:2], -1, *shape[3:])

    def _candidates(self, shell: _Shell, hypothesis: int, filtered: np.ndarray, energy: float,
                    n_measurements: int, prior: NuisancePrior) -> tuple[np.ndarray, ...]:
        """Return values, points, rates, gains and outputs of the bands of the best states."""
        directions, rates = self.grid.nodes[shell.nodes, 1:], shell.rates[hypothesis]
        outputs = np.empty((len(filtered), *shell.inverse.shape[1:]), np.complex64)
        for band, of_band in enumerate(filtered):
            np.matmul(shell.frames(hypothesis, band, of_band), self._ramps[band],
                      out=outputs[band])
        inverse = shell.inverse[hypothesis]
        # Bounds of the log-likelihood, for the best range or gain.
        amplitude, tiny = prior.amplitude(outputs), np.finfo(np.float32).tiny
        bound = amplitude**2 * inverse - self._penalty
        is_used = shell.nearest_m < shell.farthest_m
        bound[~is_used] = -np.inf
        n = min(_CANDIDATES, int(np.count_nonzero(is_used)) * len(self._speeds))
        chosen = np.argpartition(bound.ravel(), bound.size - n)[bound.size - n:]
        delay, node, speed = np.unravel_index(chosen, amplitude.shape)
        amplitude, inverse = amplitude.ravel()[chosen], inverse.ravel()[chosen]
        # The range follows from the amplitude for the median of the gain.
        best_m = 1 / np.maximum(amplitude * inverse, tiny)[None]
        if prior.gain_std:
            # In weak signals, the rest shows the gain. In strong ones, it is that of templates.
            rest = np.maximum(energy - amplitude**2 * inverse, tiny)
            _, gain = prior.maximised_over_gain(0 * rest, rest, n_measurements)
            ends_m = shell.nearest_m.min(), shell.farthest_m.max()
            n_ranges = 1 + int(np.log(ends_m[1] / ends_m[0]) / np.log(_RATIO))
            best_m = np.vstack([best_m, best_m * np.exp(gain), np.multiply.outer(
                np.geomspace(*ends_m, n_ranges + 2)[1:-1], np.ones(n))])
        best_m = np.clip(best_m, shell.nearest_m[delay, node], shell.farthest_m[delay, node])
        value, gain = prior.maximised_over_gain(amplitude / best_m, energy, n_measurements)
        value = value - 1 / (inverse * best_m**2) - self._penalty[speed] - (
            shell.squares[hypothesis, node] * best_m**2 / (2 * self._std**2))
        n_times = len(best_m)
        points = np.column_stack([best_m.ravel(), np.tile(directions[node], (n_times, 1))])
        rates = np.column_stack([self._speeds[speed], np.broadcast_to(rates, (n, 2))])
        return (value.ravel(), points, np.tile(rates, (n_times, 1)),
                np.broadcast_to(gain, value.shape).ravel(),
                np.tile(outputs.reshape(len(outputs), -1)[:, chosen].T, (n_times, 1)))
