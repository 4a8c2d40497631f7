"""An estimator without a package: the class takes the place of its name."""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimate, estimate_each, make_estimator


class RandomSearch:
    """The most likely of random positions."""

    name = 'random_search'

    def __init__(self, system, n=5000):
        self.system = system
        self.points = system.scenario.sample_positions(n, np.random.default_rng(0))
        self.means = system.whiten(system.mean(self.points))

    def estimate(self, received):
        """Return the estimate for signals of one cycle or of several, [..., N_B, N_SB F]."""
        return estimate_each(self.system.codebook, received, self._locate)

    def _locate(self, received):
        for one in self.system.whiten(received):
            distances2 = np.sum(np.abs(one - self.means)**2, axis=(1, 2))
            yield Estimate(self.points[distances2.argmin()], np.eye(3))


if __name__ == '__main__':
    estimator = make_estimator(RandomSearch, Scenario(), Codebook.default(), n=2000)
    positions, received = estimator.system.pairs(50, seed=1)
    print(np.median(np.linalg.norm(estimator.estimate(received).mean - positions, axis=1)))
