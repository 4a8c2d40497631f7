"""Detection of surfaces whose pose is wrong, from the signals of ordinary users.

The measure of a cycle is `Estimate.log_agreement` of two surfaces. Its distribution has heavy
tails: a few cycles in which a wrong mode won would dominate a mean. So each value is replaced by
its rank among the values for right poses. The mean rank of many cycles is then 1/2, with a known
standard deviation, and it is smaller if a pose is wrong.

The agreement also depends on the position of the user. If a few users move slowly, all positions
of a window are in one part of the region. Each value is then compared with the references nearby.
If these are the same few for the whole window, the mean rank has a larger standard deviation.
"""

import itertools
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from rhs_isac_ros.positioning.estimate import Sighting
from rhs_isac_ros.positioning.fusion import Fuser

# Number of latest cycles that count.
WINDOW = 50
# Number of references near a user with which an agreement is compared.
_N_NEAR = 40
# Deviations of the mean rank, in standard deviations, that right poses exceed by chance with
# probabilities of 0.1 % and 2 %: a pair fails, and a pair is doubtful if another one fails.
_FAILING, _DOUBTFUL = 3.09, 2.05

# Names of two surfaces, in alphabetical order.
Pair = tuple[str, str]


def pair_agreements(sightings: Mapping[str, Sighting], fuser: Fuser) -> dict[Pair, float]:
    """Return the logarithm of the agreement of each pair of surfaces in one cycle.

    Takes the sightings by the name of their surface. `fuser` multiplies them, unless it already
    has.
    """
    return {(one, other): float(fuser.fuse([sightings[one], sightings[other]]).log_agreement)
            for one, other in itertools.combinations(sorted(sightings), 2)}


class PoseTest:
    """A test of the poses of a site over the latest `WINDOW` cycles.

    `references` contains results of `pair_agreements` for cycles with right poses, for example
    simulated ones; a few hundred are enough. Raises ValueError without any.

    By default, the positions of users in a window are taken to be independent. If they are not,
    `places` contains the estimated positions of the references, float64 [N, 3] [m].
    """

    def __init__(self, references: Sequence[Mapping[Pair, float]],
                 places: np.ndarray | None = None) -> None:
        if not references:
            raise ValueError('references: none, expected agreements for right poses')
        pairs = {pair for cycle in references for pair in cycle}
        self._rows = {pair: np.array([pair in cycle for cycle in references])
                      for pair in sorted(pairs)}
        self._references = {
            pair: np.array([cycle[pair] for cycle in references if pair in cycle])
            for pair in self._rows}
        self._places = places
        self._ranks = {pair: deque[float](maxlen=WINDOW) for pair in self._references}
        # References with which the values of the window were compared; empty without places.
        self._near = {pair: deque[np.ndarray](maxlen=WINDOW) for pair in self._references}

    def add(self, agreements: Mapping[Pair, float], place: np.ndarray | None = None) -> None:
        """Take the result of `pair_agreements` for a cycle; pairs may be missing or new.

        `place` is the estimated position, [3] [m]; required if the references have places.
        """
        for pair in agreements.keys() & self._references.keys():
            reference = self._references[pair]
            if self._places is not None:
                distances = np.linalg.norm(self._places[self._rows[pair]] - place, axis=1)
                near = np.argsort(distances, kind='stable')[:_N_NEAR]
                self._near[pair].append(near)
                reference = reference[near]
            below = np.count_nonzero(reference < agreements[pair])
            self._ranks[pair].append((float(below) + 0.5) / (len(reference) + 1))

    def deviations(self) -> dict[Pair, float]:
        """Return how far each pair's mean rank is below 1/2, in standard deviations."""
        return {pair: float((0.5 - np.mean(ranks)) / np.sqrt(
            (1 / len(ranks) + _shared(self._near[pair])) / 12))
            for pair, ranks in self._ranks.items() if ranks}

    def suspects(self) -> tuple[str, ...]:
        """Return the surfaces of which one has a wrong pose; empty if all poses may be right.

        Of two surfaces, both are suspects. Of three or more, one wrong surface disagrees with all
        others. If no surface belongs to all pairs that disagree, several poses are wrong, and all
        surfaces of these pairs are suspects.
        """
        deviations = self.deviations()
        if not any(value > _FAILING for value in deviations.values()):
            return ()
        doubtful = [set(pair) for pair, value in deviations.items() if value > _DOUBTFUL]
        return tuple(sorted(set.intersection(*doubtful) or set.union(*doubtful)))


def _shared(near: Sequence[np.ndarray]) -> float:
    """Return the variance of the mean of references, relative to that of one of them."""
    if not near:
        return 0.0
    counts = np.bincount(np.concatenate(near))
    return float(np.sum((counts / counts.sum())**2))
