"""The modes of the posterior: found on the grid, refined by Gauss-Newton steps.

Each step moves the position and the nuisance parameters together. Around a mode, the posterior is
treated as Gaussian (Laplace's method). The information about the position is then a Schur
complement, and the mass of the mode contains the determinant of the parameters' information.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import blocks, log_sum
from rhs_isac_ros.model.gaussian import Marginal, likelihood_loss, marginalise, step_to_maximum
from rhs_isac_ros.model.geometry import to_polar, to_positions
from rhs_isac_ros.positioning.dispersed import (
    ONE_STATE,
    DispersedLikelihood,
    SurfaceState,
)
from rhs_isac_ros.positioning.grid import Starts, TemplateTable, heaviest, separate
from rhs_isac_ros.positioning.likelihood import (
    Conditional,
    Likelihood,
    Local,
    Located,
    Signals,
    WhiteMeans,
)
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.segments import Segments, concatenate, select
from rhs_isac_ros.positioning.sheets import Inside, Sheets

# Negative logarithms of the share of the posterior that discarded modes may have: on the grid,
# which is accurate to one Gauss-Newton step, and after exact steps.
GRID_MARGIN = 8.0
EXACT_MARGIN = 7.0
# That of modes of averages over surfaces, which only show whether there is a doubt: they contain
# 99 % of the evidence.
LIKELY_MARGIN = 4.6
# Maximum number of exact steps. Few modes need more than two, unless signals are strong. At the
# border of the region, small gains may alternate.
_STEPS = 8
# Number of steps to modes from which a refinement starts, which then takes steps of its own.
_COARSE = 3
# A mode has converged when its last step changed the log-likelihood by less.
_GAIN = 0.05
# Share of the latest step by which the next one turns back, above which it is shortened.
_TURN = 0.5
# Longest step of a gain [nepers].
_GAIN_STEP = 1.0
# Parts of the longest step along a line, of which the best one is taken.
_PARTS = 1.0, 0.25, 0.0625, 0.0
# Log-likelihood per u and v by which modes are ordered that are equal up to rounding, as those of
# a surface whose halves mirror each other. Otherwise, the processor would choose one.
_PREFERENCE = 1e-6 * np.array([0.0, 1.0, 0.6])


class Modes(NamedTuple):
    """Local maxima of the posterior in the region of interest, some of them on its border.

    Over an offset d in (r, u, v), the marginal log-likelihood changes by ``g^T d - d^T C d / 2``,
    with the gradient g and the curvature C.
    """

    # Shot of each mode, int [M], ascending; the most likely mode of a shot is first.
    shots: np.ndarray
    points: np.ndarray  # (r [m], u, v), float64 [M, 3].
    gradient: np.ndarray  # Float64 [M, 3]; 0 for a maximum that is not on the border.
    curvature: np.ndarray  # Float64 [M, 3, 3].
    # Marginal log-likelihood, up to a constant, float64 [M]. Without nuisance parameters and
    # errors of the elements, it is minus the energy of the whitened residual.
    log_likelihood: np.ndarray
    values: np.ndarray  # Nuisance parameters, float64 [M, Q].
    residual: np.ndarray  # Energy of the whitened residual, float64 [M].
    state: np.ndarray  # Number of the state of the surface, int [M]; 0 if there is only one.

    @property
    def centres(self) -> np.ndarray:
        """Maxima that the modes would have without the region, (r [m], u, v), float64 [M, 3]."""
        return self.points + step_to_maximum(self.curvature, self.gradient)

    @property
    def order(self) -> np.ndarray:
        """Indices of the modes of each shot, the most likely first, int [M]."""
        return np.lexsort((-self.log_likelihood - self.points @ _PREFERENCE, self.shots))

    @property
    def log_mass(self) -> float:
        """Logarithm of the integral of the likelihood over all modes."""
        return log_sum(self.log_likelihood - np.linalg.slogdet(self.curvature)[1] / 2)

    def sheets(self, share: float = 1.0) -> Sheets:
        """Return the likelihood without the limits of the region; `share` is an exponent."""
        return Sheets.expanded(
            self.points, self.gradient, self.curvature, self.log_likelihood, share)

    def starts(self) -> Starts:
        """Return the points, to start another search from them."""
        return Starts(self.shots, self.points, self.values)

    def replace(self, rows: np.ndarray, others: 'Modes') -> None:
        """Overwrite the modes in `rows` with other modes."""
        for field, new in zip(self, others, strict=True):
            field[rows] = new

    def of_shot(self, shot: int) -> 'Modes':
        """Return the modes of one shot."""
        return select(self, slice(*np.searchsorted(self.shots, (shot, shot + 1))))


class Refinement(Protocol):
    """Modes and likelihoods with regard to what is unknown about the elements of the surface."""

    #: Margin of the search for modes beyond the usual one.
    margin: float
    #: Whether the likelihood of a shot is `Likelihood`.
    is_exact: bool

    def refine(self, modes: Modes, signals: Signals, table: TemplateTable
               ) -> tuple[Modes, dict[int, Sequence[Conditional]]]:
        """Return refined modes, and the likelihoods for each state of the surface by shot.

        Takes modes of `Likelihood`, and the table in which they were found.
        """
        ...

    def same(self, other: Conditional) -> Conditional:
        """Return the likelihood for the state of the surface of another `Likelihood`'s."""
        ...

    def gain(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> float:
        """Return the log evidence of one shot that averages over surfaces ignore, at least 0.

        Takes points elsewhere, [P, 3], with parameters [P, Q], where a user may be instead.
        """
        ...


class OneState:
    """Refinement for elements that are known, or whose errors are averaged: a `Refinement`.

    With a `margin`, that of `ascend`, modes without weight are left out.
    """

    margin = 0.0

    def __init__(self, likelihood: Likelihood, margin: float = np.inf) -> None:
        self._likelihood, self._margin = likelihood, margin
        self._dispersed = DispersedLikelihood.of(likelihood)
        self._conditional: Conditional = self._dispersed or likelihood
        self.is_exact = self._conditional is likelihood

    def states(self, of: Callable[[MeasurementModel], np.ndarray]) -> Sequence[SurfaceState]:
        """Return the states of the surface; see `DispersedLikelihood.states`."""
        return self._dispersed.states(of) if self._dispersed else ONE_STATE

    def refine(self, modes: Modes, signals: Signals, table: TemplateTable
               ) -> tuple[Modes, dict[int, Sequence[Conditional]]]:
        """Take one step in the likelihood with the errors; see `Refinement.refine`."""
        if not self.is_exact:
            modes = ascend(
                self._conditional, self._likelihood, modes.starts(), signals, 1, self._margin)
        return modes, dict.fromkeys(np.unique(modes.shots).tolist(), [self._conditional])

    def same(self, other: Conditional) -> Conditional:
        """Return the only likelihood; see `Refinement.same`."""
        return self._conditional

    def gain(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> float:
        """Return 0, because the evidence is that of averages; see `Refinement.gain`."""
        return 0.0


def find_modes(likelihood: Likelihood, grid: TemplateTable, signals: Signals,
               aligned: np.ndarray) -> Modes:
    """Find the modes with a substantial weight in the posterior of each of N shots.

    The most likely mode of each shot comes first. `aligned` is that of `modes_from`.
    """
    starts = grid.starts(likelihood.whitened(aligned, signals), likelihood.nuisance, GRID_MARGIN)
    return modes_from(starts, likelihood, signals, aligned)


def modes_from(starts: Starts, likelihood: Likelihood, signals: Signals, aligned: np.ndarray,
               extra_margin: float = 0.0, is_last: bool = True) -> Modes:
    """Ascend from the starts on the grid to the modes; see `find_modes`.

    `aligned`, float64 [N, Q], contains the parameters that follow from the signals alone, and 0
    for the others. `extra_margin` admits modes that are less likely than usual. Unless the modes
    are the last ones, a refinement continues from them.
    """
    starts = starts._replace(values=starts.values + aligned[starts.shots])
    return ascend(likelihood, likelihood, starts, signals,
                  _STEPS if is_last else _COARSE, EXACT_MARGIN + extra_margin)


def likely_modes(modes: Modes) -> Modes:
    """Return the modes of each shot, the most likely first, without those of little weight."""
    return select(modes, heaviest(
        Segments.of_keys(modes.shots), modes.log_likelihood, LIKELY_MARGIN))


def ascend(conditional: Conditional, likelihood: Likelihood, starts: Starts, signals: Signals,
           n_steps: int, margin: float = EXACT_MARGIN, state: int = 0) -> Modes:
    """Take up to `n_steps` Gauss-Newton steps from the starts to the modes of the posterior.

    `conditional` is the likelihood for the state of the surface with the number `state`. `margin`
    is the negative logarithm of the share of the posterior that discarded modes may have.
    """
    def step(starts: Starts, moves: bool = True) -> tuple[Modes, np.ndarray]:
        parts = [one_step(conditional, likelihood, one, signals if is_alone else select(
            signals, one.shots), state, moves) for one in (select(starts, block) for block in (
                blocks(len(starts.shots), conditional.n_at_once)))]
        found, gains = zip(*parts, strict=True)
        return concatenate(*found), np.concatenate(gains)

    is_alone = len(signals.received) == 1
    modes, gain = step(starts)
    # Points that the latest steps started from, and the known log-likelihoods there.
    origins, known = starts, modes.log_likelihood - gain
    # Shots whose modes have changed. The modes of the others stay, whatever happens to shots that
    # are located together with them.
    changed = starts.shots
    for number in range(n_steps):
        chosen = _prune(likelihood, modes, gain, margin, changed)
        modes, origins = select(modes, chosen), select(origins, chosen)
        gain, known = gain[chosen], known[chosen]
        (moving,) = (np.abs(gain) > _GAIN).nonzero()
        if not len(moving) or number == n_steps - 1:
            break
        changed = modes.shots[moving]
        here = select(modes, moving).starts()
        moved, new_gain = step(here)
        reached = moved.log_likelihood - new_gain
        _shorten(moved, new_gain, here, origins.points[moving], likelihood.resolution.bounds_m)
        too_long = reached < known[moving] - _GAIN
        short, long = moving[~too_long], moving[too_long]
        origins.points[short], origins.values[short] = modes.points[short], modes.values[short]
        known[short], gain[short] = reached[~too_long], new_gain[~too_long]
        modes.replace(short, select(moved, ~too_long))
        if len(long):
            _halve(modes, origins, gain, long)
    # Before convergence, the predicted likelihood may be arbitrarily wrong.
    (moving,) = np.nonzero((np.abs(gain) > _GAIN) | (len(likelihood.nuisance) > 0))
    if len(moving):
        modes.replace(moving, step(select(modes, moving).starts(), moves=False)[0])
        (worse,) = np.nonzero(modes.log_likelihood < known - _GAIN)
        if len(worse):
            modes.replace(worse, step(select(origins, worse), moves=False)[0])
        gain[moving] = 0.0
        modes = select(modes, _prune(likelihood, modes, gain, margin, modes.shots[moving]))
    return modes


def _shorten(moved: Modes, gain: np.ndarray, here: Starts, origins: np.ndarray,
             bounds_m: np.ndarray) -> None:
    """Shorten steps to the modes if those from the origins, [M, 3], to `here` were too long.

    Expected information may be below the curvature, so that each step turns back. Along the latest
    step, the change of the gradient shows the curvature.
    """
    (rows,) = np.nonzero(np.abs(gain) > _GAIN)
    if not len(rows):
        return
    before, step = (here.points - origins)[rows], (moved.points - here.points)[rows]
    slopes = np.matmul(moved.curvature[rows], before[..., None])[..., 0]
    back = -np.sum(step * slopes, axis=1) / np.maximum(
        np.sum(before * slopes, axis=1), np.finfo(float).tiny)
    turned = back > _TURN
    if turned.any():
        rows, left = rows[turned], 1 - 1 / (1 + np.minimum(back[turned], 1.0))
        points = moved.points[rows] - left[:, None] * step[turned]
        moved.points[rows] = to_polar(np.clip(to_positions(points), *bounds_m))
        moved.values[rows] -= left[:, None] * (moved.values - here.values)[rows]
        moved.log_likelihood[rows] -= left * gain[rows]
        moved.residual[rows] += left * gain[rows]
        gain[rows] *= 1 - left


def _halve(modes: Modes, origins: Starts, gain: np.ndarray, rows: np.ndarray) -> None:
    """Halve the steps from the origins to the modes in `rows`, and predict their gains."""
    # Between two positions in the region, all others are in the region, too.
    modes.points[rows] = to_polar(
        (to_positions(origins.points[rows]) + to_positions(modes.points[rows])) / 2)
    modes.values[rows] = (origins.values[rows] + modes.values[rows]) / 2
    # The gain of a quadratic function over half of the step to its maximum is 3/4 of the whole.
    modes.log_likelihood[rows] -= gain[rows] / 4
    modes.residual[rows] += gain[rows] / 4
    gain[rows] *= 3 / 4


def marginal_at(conditional: Conditional, likelihood: Likelihood, points: np.ndarray,
                values: np.ndarray, signals: Signals, n_held: int = 0
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the marginal log-likelihood at M points, [M], and the best parameters, [M, Q].

    Newton steps start from the approximate parameters `values`, [M, Q], of which the first
    `n_held` do not change: none, or the velocity. Also returns the information about the others,
    [M, Q, Q].
    """
    def of_block(block: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shots = signals if len(signals.received) == 1 else select(signals, block)
        located, white, settled = _settled(
            conditional, likelihood, points[block], values[block], shots, moves=False,
            turns=not n_held)
        return _maximised(located, white, settled, likelihood, shots, n_held)[:3]

    value, best, information = map(np.concatenate, zip(*(
        of_block(block) for block in blocks(len(points), conditional.n_at_once)), strict=True))
    return value, best, information


def _maximised(located: Located, white: Located, values: np.ndarray, likelihood: Likelihood,
               signals: Signals, n_held: int = 0) -> tuple[
                   np.ndarray, np.ndarray, np.ndarray, Local]:
    """Return the results of `marginal_at`, and the likelihood before the last step."""
    for _ in range(2 if values.shape[1] and not likelihood.nuisance.velocity.size else 1):
        before, local = values, located.local(values, signals)
        first = local.gradient.shape[1] - values.shape[1] + n_held
        information, gradient = local.information[:, first:, first:], local.gradient[:, first:]
        marginal = marginalise(information, gradient, 0)
        values = np.hstack([values[:, :n_held], values[:, n_held:] + marginal.offset])
    rise = np.sum(gradient * marginal.offset, axis=1) / 2
    value = local.value + rise + marginal.log_volume
    if likelihood.nuisance.is_coarse:
        assert isinstance(white, WhiteMeans)
        shares = _determined(information, likelihood, before, n_held)
        value -= np.sum(shares * white.log_excess(before, signals)[:, n_held:], axis=1) / 2
    return value, values, information, local


def _determined(information: np.ndarray, likelihood: Likelihood, values: np.ndarray,
                n_held: int = 0) -> np.ndarray:
    """Return the share of the information about each parameter that is due to the direct path.

    `information`, [M, Q, Q], is that about the parameters `values` after the first `n_held`.
    """
    prior, noise = likelihood.nuisance, likelihood.factors.noise
    known = (np.diag(prior.precision) + prior.information)[None]
    if noise is not None:
        known = known - prior.hidden(prior.noise_weights(values @ prior.gains.T, noise)[1])
    others = np.diagonal(np.linalg.solve(
        information, known[:, n_held:, n_held:]), axis1=1, axis2=2)
    # What a few measurements of the multipath say about an offset may be far less than expected.
    # Whatever remains is then not due to the direct path.
    found: np.ndarray = 1 - np.clip(others, 0.0, 1.0)
    return found


def expanded_at(conditional: Conditional, likelihood: Likelihood, points: np.ndarray,
                values: np.ndarray, signals: Signals
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the marginal log-likelihood at M points, [M], its gradient, and its curvature.

    The arguments are those of `marginal_at`.
    """
    located, white, values = _settled(conditional, likelihood, points, values, signals)
    value, values, _, local = _maximised(located, white, values, likelihood, signals)
    if values.shape[1]:
        local = _with_volume(located.local(values, signals), white, values, likelihood)
    marginal = marginalise(local.information, local.gradient)
    return value, marginal.gradient, marginal.information


def _with_volume(local: Local, white: Located, values: np.ndarray, likelihood: Likelihood
                 ) -> Local:
    """Add the derivative of the parameters' volume with respect to the point to the gradient.

    The curvature in the parameters that the direct path determines is proportional to its
    amplitude. Within narrow modes, it hardly changes.
    """
    prior = likelihood.nuisance
    if prior.is_coarse:
        assert isinstance(white, WhiteMeans)
        determined = np.sum(_determined(
            local.information[:, 3:, 3:], likelihood, values), axis=1)
        local.gradient[:, :3] -= determined[:, None] / 2 * white.growth[:, :3]
    return local


def _settled(conditional: Conditional, likelihood: Likelihood, points: np.ndarray,
             values: np.ndarray, signals: Signals, moves: bool = True, turns: bool = True
             ) -> tuple[Located, Located, np.ndarray]:
    """Return the likelihood at points, and parameters [M, Q] with the most likely phases.

    The second result has only one covariance if phases are uniform.
    """
    located = white = conditional.at(points, values, moves=moves, turns=turns)
    # A step in range rotates uniform phases of bands by many turns.
    if likelihood.nuisance.is_coarse:
        if not isinstance(white, WhiteMeans):
            white = likelihood.at(points, values, moves=moves, turns=turns)
        values = white.settled(values, signals)
    return located, white, values


def one_step(conditional: Conditional, likelihood: Likelihood, starts: Starts, signals: Signals,
             state: int = 0, moves: bool = True) -> tuple[Modes, np.ndarray]:
    """Take a Gauss-Newton step, or none without `moves`; return the modes and gains, [M].

    Takes the signals of one shot or of each start. The modes are as predicted at the starts.
    """
    points = starts.points
    located, white, values = _settled(conditional, likelihood, points, starts.values, signals)
    local = _with_volume(located.local(values, signals), white, values, likelihood)
    marginal = marginalise(local.information, local.gradient)
    step = step_to_maximum(marginal.information, marginal.gradient)
    whole = np.zeros_like(local.gradient)
    if moves:
        whole = _with_parameters(
            marginal, _inside(points, marginal, step, likelihood), likelihood.nuisance)
    step, gain = whole[:, :3], _rise(local, whole)
    modes = Modes(
        starts.shots, points + step,
        marginal.gradient - np.matmul(marginal.information, step[..., None])[..., 0],
        marginal.information, local.value + marginal.log_volume + gain, values + whole[:, 3:],
        local.residual - gain, np.full(len(points), state))
    return modes, gain


def _inside(points: np.ndarray, marginal: Marginal, step: np.ndarray, likelihood: Likelihood
            ) -> np.ndarray:
    """Limit steps [M, 3], and change those that leave the region to the best ones that do not."""
    bounds, limits = likelihood.resolution.bounds_m, _limits(likelihood)
    step = np.minimum(np.maximum(step, -limits), limits)  # Faster than `np.clip`.
    ends = to_positions(points + step)
    (outside,) = ((ends < bounds[0]) | (ends > bounds[1])).any(axis=1).nonzero()
    if len(outside):
        starts = points[outside]
        best = Inside.of(
            starts, marginal.gradient[outside], marginal.information[outside], bounds).nearest()
        step[outside] = _best_towards(starts, best, limits, bounds, select(marginal, outside))
    return step


def _best_towards(starts: np.ndarray, best: np.ndarray, limits: np.ndarray, bounds: np.ndarray,
                  marginal: Marginal) -> np.ndarray:
    """Return the most likely limited steps from points [M, 3] towards positions in the region.

    A position within the limits of each coordinate may be unlikely, as these change together. On
    the line to a position, the range has a minimum, so that only short steps may be better.
    """
    here, whole = to_positions(starts), to_polar(best) - starts
    shares = np.minimum(1.0, np.min(limits / np.maximum(
        np.abs(whole), np.finfo(float).tiny), axis=1))
    ends = [to_positions(starts + np.clip(whole, -limits, limits)),
            *(here + (shares * part)[:, None] * (best - here) for part in _PARTS)]
    steps = to_polar(np.clip(ends, *bounds)) - starts
    gains = [np.einsum('mp,mp->m', marginal.gradient, one)
             - likelihood_loss(one, marginal.information) for one in steps]
    chosen: np.ndarray = steps[np.argmax(gains, axis=0), np.arange(len(starts))]
    return chosen


def predict(local: Local, likelihood: Likelihood) -> np.ndarray:
    """Predict the marginal log-likelihood after a Gauss-Newton step, float64 [M].

    Far from a fit, the observed slope along a gain is steeper than the expected curvature allows.
    No step removes more than the residual.
    """
    marginal, limits = marginalise(local.information, local.gradient), _limits(likelihood)
    step = step_to_maximum(marginal.information, marginal.gradient)
    whole = _with_parameters(
        marginal, np.clip(step, -limits, limits), likelihood.nuisance)
    return local.value + marginal.log_volume + np.minimum(_rise(local, whole), local.residual)


def _limits(likelihood: Likelihood) -> np.ndarray:
    return likelihood.resolution.step_limits(likelihood.nuisance.is_coarse)


def _with_parameters(marginal: Marginal, step: np.ndarray, prior: NuisancePrior) -> np.ndarray:
    """Append the best steps of the nuisance parameters to steps of the points, [M, 3 + Q].

    Where noise hides the signals, hardly anything limits a gain without a prior. Its step is
    limited, and all others with it.
    """
    change = np.matmul(marginal.regression, step[..., None])[..., 0]
    whole = np.hstack([step, marginal.offset + change])
    if prior.has_gain:
        largest = np.abs(whole[:, 3:] @ prior.gains.T).max(axis=1)
        whole *= (_GAIN_STEP / np.maximum(largest, _GAIN_STEP))[:, None]
    return whole


def _rise(local: Local, whole: np.ndarray) -> np.ndarray:
    """Return the increase of the log-likelihood over steps [M, 3 + Q]."""
    rise: np.ndarray = np.einsum('mp,mp->m', local.gradient, whole)
    return rise - likelihood_loss(whole, local.information)


def _prune(likelihood: Likelihood, modes: Modes, gain: np.ndarray, margin: float,
           changed: np.ndarray) -> np.ndarray:
    """Return indices of the probable, separate modes of each shot, the most likely first.

    All modes of shots that are not in `changed` are kept, in their order.
    """
    # The likelihood of a mode is a prediction, and may be arbitrarily wrong before convergence.
    # The likelihood before the last step is known, and its maximum limits the best prediction.
    value = modes.log_likelihood + np.abs(gain)
    has_changed = np.zeros(modes.shots[-1] + 1, bool)
    has_changed[changed] = True
    order, chosen = modes.order, has_changed[modes.shots]
    rest, order = order[~chosen[order]], order[chosen[order]]
    of_shot = Segments.of_keys(modes.shots[order])
    known = (modes.log_likelihood - gain)[order]
    best = np.minimum(of_shot.first(modes.log_likelihood[order]), of_shot.max(known))
    relative = value[order] - of_shot.repeat(best)
    order = order[heaviest(of_shot, np.minimum(relative, 0.0), margin)]
    points = modes.points[order]
    rates = likelihood.rates(modes.values[order], points)
    points, radii = np.hstack([points, rates]), np.append(
        likelihood.resolution.separation(likelihood.nuisance.is_coarse), np.ones(rates.shape[1]))
    order = order[separate(modes.shots[order], points, radii, modes.curvature[order])]
    kept = np.concatenate([rest, order])
    return kept[np.argsort(modes.shots[kept], kind='stable')] if len(rest) else order
