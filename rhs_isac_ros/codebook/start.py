"""Codebooks to start an optimisation from."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.directional import directional_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels


def random_codebook(scenario: Scenario, rng: np.random.Generator) -> Codebook:
    """Draw random configurations: the paper's `Random`, and the start of its optimisation.

    C is uniform in [0, 1], or rounded to the levels of the elements; every entry of S is
    sqrt(P_max / (K N_SB)).
    """
    sizes = scenario.sizes
    analog = on_levels(scenario, rng.uniform(size=[sizes[s] for s in ('N_B', 'F', 'N_E')]))
    weight = np.sqrt(scenario.max_power_w / (sizes['K'] * sizes['N_SB']))
    digital = np.full((sizes['N_B'], sizes['N_SB'], sizes['F'], sizes['K']), weight, complex)
    return Codebook(analog, digital, provenance='random')


STARTS: Mapping[str, Callable[[Scenario, np.random.Generator], Codebook]] = {
    'random': random_codebook, 'directional': directional_codebook}
