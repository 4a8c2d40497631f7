"""Simulate positioning phases, locate the users, and compare with the bound."""

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator

scenario = Scenario.from_yaml('config/quick.yaml')  # Scenario() is Table I of the paper
codebook = Codebook.load('config/codebook_quick.yaml')
rng = np.random.default_rng(1)
positions = scenario.sample_positions(3, rng)  # [N, 3], metres
received = simulate_received(scenario, codebook, positions, rng)
fix = make_estimator('bayes', scenario, codebook).estimate(received)
print(fix.mean - positions)  # m
print(crlb(scenario, codebook, positions))  # m^2
