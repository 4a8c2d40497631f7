"""Simulate positioning phases, locate the users, and compare with the bound."""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.system import System

scenario = Scenario.from_yaml('config/quick.yaml')  # Scenario() is Table I of the paper
system = System(scenario, Codebook.load('config/codebook_quick.yaml'))
rng = np.random.default_rng(1)
positions = scenario.sample_positions(3, rng)  # [N, 3], metres
received = system.sample(positions, rng)
fix = BayesEstimator(system).estimate(received)
print(fix.mean - positions)  # m
print(system.crlb(positions))  # m^2
