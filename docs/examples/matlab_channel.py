"""Paths from MATLAB as a channel.

In MATLAB, with the arrays of the table of propagation paths:

    save('hall.mat', 'users', 'a', 'src', 'n', 'f0')  % or with '-v7.3', which needs h5py here
"""

import sys

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator

scenario = Scenario(channel=sys.argv[1])
users = scenario.channel.users
received = simulate_received(scenario, Codebook.default(), users, np.random.default_rng(0))
estimate = make_estimator('bayes', Scenario(), Codebook.default()).estimate(received)
print(np.linalg.norm(estimate.mean - users, axis=1))
