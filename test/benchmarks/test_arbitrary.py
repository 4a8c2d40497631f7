"""Scenarios that are drawn at random."""

import numpy as np
import pytest
from benchmarks import arbitrary


def test_every_seed_draws_another_valid_scenario():
    scenarios = [arbitrary.draw(np.random.default_rng(seed)) for seed in range(60)]
    assert len({one.id for one in scenarios}) == 60
    dimensions = {np.count_nonzero(one.roi_size_m) for one in scenarios}
    assert dimensions == {1, 2, 3}
    for name in arbitrary.UNKNOWN:
        assert 0 < sum(bool(getattr(one, name)) for one in scenarios) < 60


def test_a_row_is_marked_if_chance_does_not_explain_it(monkeypatch):
    figures = arbitrary.measure(2, 8)
    assert not figures['marked']
    assert figures['fix'][0] == 100
    assert 0.2 < figures['nees'][0] < 3
    assert '2.7 GHz, 1 x 4 x 6' in figures['about']
    monkeypatch.setattr(arbitrary, 'MOST_NEES', figures['nees'][1] / 2)
    assert arbitrary.measure(2, 8)['marked']


@pytest.mark.parametrize('name', arbitrary.UNKNOWN)
def test_descriptions_name_what_is_unknown(name):
    scenario = arbitrary.draw(np.random.default_rng(9))
    assert (f', {name} ' in arbitrary.about(scenario)) == bool(getattr(scenario, name))
