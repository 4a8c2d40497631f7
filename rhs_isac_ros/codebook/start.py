"""Codebooks that need no optimisation."""

import numpy as np

from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.model import Scenario


def random_codebook(scenario: Scenario, rng: np.random.Generator) -> Codebook:
    """Uniform configurations and equal combining weights: the paper's `Random` and starting point.

    Parameters
    ----------
    scenario
        The scenario.
    rng
        Source of randomness.

    Returns
    -------
    Codebook
        Analog uniform in [0, 1]; digital sqrt(P_max / (K N_SB)) throughout.
    """
    sizes = scenario.sizes
    analog = rng.uniform(size=(sizes['N_B'], sizes['F'], sizes['N_E']))
    weight = np.sqrt(scenario.max_power_w / (sizes['K'] * sizes['N_SB']))
    digital = np.full((sizes['N_B'], sizes['N_SB'], sizes['F'], sizes['K']), weight, complex)
    return Codebook(analog, digital, provenance='random')
