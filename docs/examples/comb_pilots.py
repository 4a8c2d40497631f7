"""Pilots on a comb: the more sub-carriers they span, the better the range."""

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario

for comb in (1, 4, 12):
    scenario = Scenario(
        center_frequencies_hz=(3.5e9,), n_subbands=24, subband_width_hz=30e3,
        subband_spacing_hz=30e3 * comb, n_frames=8, multipath_to_los_db=-20,
        phase_std_rad=2 * np.pi)
    codebook = random_codebook(scenario, np.random.default_rng(0))
    positions = scenario.sample_positions(100, np.random.default_rng(1))
    print(f'comb {comb:2}: {scenario.bandwidth_hz / 1e6:.2f} MHz, median bound '
          f'{np.median(crlb(scenario, codebook, positions))**0.5:.2f} m')
