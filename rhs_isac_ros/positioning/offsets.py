"""Offsets of carrier and timing, estimated from the signals before the position is known."""

import functools

import numpy as np

from rhs_isac_ros.model.arrays import blocks, multiply_rows
from rhs_isac_ros.model.gaussian import quadratic_form, step_to_maximum
from rhs_isac_ros.positioning.likelihood import Likelihood

# Grid on which parameters with several maxima are compared.
_REACH = 4.0  # In standard deviations.
_POINTS = (513, 49, 13, 5)  # Per parameter, for 1, 2, 3 and more parameters.
_POINTS_PER_TURN = 6  # Of the phase between two measurements, if these are more.
_BLOCK = 1 << 20  # Number of complex numbers at a time.
_REFINEMENTS = 4  # Of the best point.
# Errors of the estimates, in standard deviations, whose effect the margin covers, and largest
# margin. Where errors at the best mode cost more than a share of it, the search is repeated.
_DEVIATION = 4.0
_MARGIN = 200.0
_SHARE = 0.5
# Smallest eigenvalue of a sum of signals, as a share of its trace.
_MIN_SPREAD = 1e-12


class Alignment:
    """Estimates of the parameters that move the multipath, from the signals alone.

    Offsets of carrier and timing move the multipath out of the nulls of its covariance, so they
    must be known before the search. `spread`, from `tabulate`, contains the second moments of the
    whitened means over the region, and accounts for the unknown position. `margin` is the loss of
    log-likelihood that usual errors of the estimates cause at the true position.
    """

    def __init__(self, likelihood: Likelihood, spread: np.ndarray) -> None:
        self._prior = likelihood.nuisance
        # Most grids have one part, whose factors are kept; they can be pickled and copied.
        self._latest_factors: tuple[slice, np.ndarray] | None = None
        # Strong signals must not make the sum singular up to rounding errors.
        least = np.maximum(_MIN_SPREAD * np.trace(spread, axis1=1, axis2=2).real, 1.0)
        roots = np.linalg.cholesky(spread + least[:, None, None] * np.eye(spread.shape[1]))
        self._whitener = np.linalg.solve(roots, likelihood.model.whitener)
        moves = np.ix_(*2 * [self._prior.moves_multipath])
        known = self._prior.information_of(likelihood.model.root @ roots, self._whitener)
        precision = (known + np.diag(self._prior.precision))[moves]
        # Information in the direct path of an average user, per energy of the whitened mean.
        self._information = self._prior.direct_information(spread)
        loss = np.trace(np.linalg.solve(precision, self._information[moves])) / 2
        self.margin = min(_DEVIATION**2 * float(loss), _MARGIN)
        self._information /= max(
            float(np.trace(spread, axis1=1, axis2=2).real.sum()), np.finfo(float).tiny)

    def is_wrong(self, errors: np.ndarray, energies: np.ndarray) -> np.ndarray:
        """Return whether errors [N, Q] cost more than a part of the margin allows, bool [N].

        `energies`, [N], are those of the whitened direct paths.
        """
        moves = self._prior.moves_multipath
        information = self._information[np.ix_(moves, moves)]
        squares = np.einsum('np,pq,nq->n', errors[:, moves], information, errors[:, moves])
        wrong: np.ndarray = energies * squares / 2 > _SHARE * self.margin
        return wrong

    def values_of_each(self, received: np.ndarray, starts: np.ndarray | None = None
                       ) -> np.ndarray:
        """Estimate the parameters [N, Q] that move the multipath; all others are 0.

        Without `starts`, approximate parameters [N, Q], they are searched for on a grid.
        """
        if not self._prior.moves_multipath.any():
            return np.zeros((len(received), len(self._prior)))
        if starts is None:
            starts = self._best_on_grid(received)
        prior, moves, values = self._prior, self._prior.moves_multipath, starts.copy()
        for _ in range(_REFINEMENTS):
            divided = prior.divide(received, values)[:, None]
            white = multiply_rows(self._whitener, np.concatenate(
                [divided, prior.scaled_patterns[moves] * divided], axis=1))
            products = quadratic_form(white.reshape(*white.shape[:2], -1))
            # With an unknown gain, the energy is normalised.
            if prior.gain_std:
                products *= 2 * white[0, 0].size / products[:, :1, :1]
            values[:, moves] += step_to_maximum(
                products[:, 1:, 1:] + np.diag(prior.precision[moves]),
                products[:, 1:, 0] - prior.precision[moves] * values[:, moves])
        return values

    def _best_on_grid(self, received: np.ndarray) -> np.ndarray:
        """Return the best grid values, [N, Q], of parameters with several maxima."""
        prior = self._prior
        if not prior.needs_search.any():
            return np.zeros((len(received), len(prior)))
        # Measurements with equal factors count together. The energy is a quadratic form.
        candidates, groups = self._candidates, self._groups
        white = multiply_rows(
            np.moveaxis(self._whitener[:, :, groups], 2, 1), received[:, :, groups])
        products = np.matmul(white.conj(), np.swapaxes(white, 2, 3))
        parts = blocks(len(candidates), max(_BLOCK // products[..., 0].size, 1))
        cost = np.empty((len(received), len(candidates)))
        for part in parts:
            factors = self._factors(part)
            turned = np.matmul(factors, np.swapaxes(products, 2, 3))
            cost[:, part] = np.einsum(
                'bcg,nbcg->nc', factors.view(float), turned.view(float))
        if prior.gain_std:
            cost = received[0].size * np.log(cost)
        cost += candidates**2 @ prior.precision / 2
        # Half a period of the timing may change nothing; then rounding must not decide.
        return candidates[np.argmin(np.round(cost, 6), axis=1)]

    @functools.cached_property
    def _candidates(self) -> np.ndarray:
        """Parameters on the grid, float64 [C, Q]."""
        prior = self._prior
        (searched,) = np.nonzero(prior.needs_search)
        n_grid = _POINTS[min(len(searched), len(_POINTS)) - 1]
        # Beyond half a period, the signals repeat.
        reach = np.minimum(_REACH, prior.half_period[searched])
        turns = reach * np.ptp(prior.scaled_patterns[searched].imag, axis=(1, 2))
        counts = np.maximum(n_grid, np.ceil(_POINTS_PER_TURN * turns / np.pi)).astype(int)
        lines = [np.linspace(-most, most, n)
                 for most, n in zip(reach, counts.tolist(), strict=True)]
        grid = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1)
        candidates = np.zeros((grid[..., 0].size, len(prior)))
        candidates[:, searched] = grid.reshape(len(candidates), -1)
        return candidates

    @functools.cached_property
    def _groups(self) -> np.ndarray:
        """Indices of the measurements of a band for which factors are equal, int [G, S]."""
        scenario, prior = self._prior.scenario, self._prior
        shape = scenario.n_subbands, scenario.n_frames
        patterns = prior.scaled_patterns[prior.needs_search].reshape(-1, *shape)
        rows = np.arange(np.prod(shape)).reshape(shape)
        if not np.ptp(patterns, axis=2).any():
            return rows
        return rows.ravel()[:, None] if np.ptp(patterns, axis=1).any() else rows.T

    def _factors(self, part: slice) -> np.ndarray:
        """Return factors that candidates remove from `_groups`, complex128 [N_B, C, G]."""
        latest = self._latest_factors
        if latest is None or latest[0] != part:
            patterns = self._prior.scaled_patterns[:, :, self._groups[:, 0]]
            exponents = np.tensordot(self._candidates[part], patterns, 1)
            latest = part, np.ascontiguousarray(np.swapaxes(np.exp(-exponents), 0, 1))
            self._latest_factors = latest
        return latest[1]
