"""The random codebook, the default start."""

import numpy as np

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario


def test_random_codebook_is_the_papers_start():
    scenario = Scenario(max_power_w=0.5, elements_per_side=30)
    codebook = random_codebook(scenario, np.random.default_rng(0))
    codebook.check(scenario)
    # K = 3 feeds and N_SB = 8 sub-bands share the power evenly.
    np.testing.assert_allclose(codebook.digital, np.sqrt(0.5 / 24), rtol=1e-12)
    # Uniform on [0, 1]: 7200 entries.
    ordered = np.sort(codebook.analog.ravel())
    assert np.abs(ordered - (np.arange(7200) + 0.5) / 7200).max() < 0.02


def test_random_codebook_depends_only_on_the_generator(small):
    one, same, other = (random_codebook(small.scenario, np.random.default_rng(seed))
                        for seed in (1, 1, 2))
    assert one.id == same.id
    assert one.id != other.id
