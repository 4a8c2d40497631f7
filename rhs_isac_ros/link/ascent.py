"""Ascent of the capacity from a configuration to a maximum nearby."""

import dataclasses

import numpy as np

from rhs_isac_ros.link.band_link import BandLink

# Rounds at most; one or two are usual.
_ROUNDS = 50
# Relative gain of the capacity that is not worth another round.
_TOLERANCE = 1e-9


def ascend(link: BandLink, analog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Raise the capacity until no step gains: never falls below the start.

    Each round finds the best digital part and, this one held, a better configuration. The received
    power is convex in the configuration, so that it lies above its linear model at any point: the
    corner of the box to which the slope points has more power, unless the point is that corner.
    The sum of logarithms follows the power closely but not always, so the outcome is compared. If
    it does not gain, the one element counts that gains most at an end of its range.

    Parameters
    ----------
    link
        The link.
    analog
        Configuration to start from, float64 [N_E], each entry in [0, 1].

    Returns
    -------
    tuple of numpy.ndarray
        Configuration, float64 [N_E], each entry in [0, 1], and the digital part that is best for
        it, complex128 [N_SB, K] [sqrt(W)].
    """
    here = _Point.at(link, analog)
    for _ in range(_ROUNDS):
        better = here.toward_corner()
        if better is None:
            better = here.one_element()
        if better is None:
            break
        here = _Point.at(link, better)
    return here.analog, here.digital


@dataclasses.dataclass(frozen=True, eq=False)
class _Point:
    """A configuration with the digital part that is best for it, and the capacity around it.

    Attributes
    ----------
    link
        The link.
    analog
        The configuration, float64 [N_E].
    digital
        The digital part, complex128 [N_SB, K] [sqrt(W)].
    weights
        Digital part and on-board propagation over noise, complex128 [N_SB, N_E].
    toward
        The same with the line of sight, complex128 [N_SB, N_E].
    ratios
        Ratio of signal to noise, float64 [N_SB].
    slopes
        Derivative of the ratios by the configuration, float64 [N_SB, N_E].
    """

    link: BandLink
    analog: np.ndarray
    digital: np.ndarray
    weights: np.ndarray
    toward: np.ndarray
    ratios: np.ndarray
    slopes: np.ndarray

    @classmethod
    def at(cls, link: BandLink, analog: np.ndarray) -> '_Point':
        digital = link.best_digital(analog)
        weights = np.einsum('jk,jkm->jm', digital, link.onboard) / np.sqrt(link.noise_w)
        toward = weights * link.los
        direct, patterns = toward @ analog, weights * analog
        diffuse = np.conj(link.scatter(patterns))
        ratios = np.abs(direct)**2 + np.sum(patterns * diffuse, axis=1).real
        slopes = 2 * (np.conj(direct)[:, None] * toward + weights * diffuse).real
        return cls(link, analog, digital, weights, toward, ratios, slopes)

    def toward_corner(self) -> np.ndarray | None:
        """The corner that the slope points to, if that gains."""
        corner = (1 / (1 + self.ratios) @ self.slopes > 0).astype(float)
        direct, patterns = self.toward @ corner, self.weights * corner
        scattered = np.sum(self.link.scatter(patterns) * np.conj(patterns), axis=1).real
        return corner if self._gains(np.abs(direct)**2 + scattered) else None

    def one_element(self) -> np.ndarray | None:
        """The best change of one element to an end of its range, if one gains."""
        curvatures = np.abs(self.toward)**2
        curvatures += np.abs(self.weights)**2 * np.diag(self.link.spatial)
        steps = np.stack([-self.analog, 1 - self.analog])[:, None]
        # Exact, as the power is quadratic in each element; negative by rounding alone.
        ratios = self.ratios[:, None] + steps * self.slopes + steps**2 * curvatures
        ratios = np.maximum(ratios, 0)
        end, element = np.unravel_index(
            np.log1p(ratios).sum(axis=1).argmax(), (2, len(self.analog)))
        if not self._gains(ratios[end, :, element]):
            return None
        better = self.analog.copy()
        better[element] = end
        return better

    def _gains(self, ratios: np.ndarray) -> bool:
        """Whether other ratios of signal to noise mean a higher capacity."""
        rate = np.log1p(self.ratios).sum()
        return bool(np.log1p(ratios).sum() - rate > _TOLERANCE * rate)
