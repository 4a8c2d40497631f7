"""Scenarios that are drawn at random."""

import numpy as np
import pytest
from benchmarks import arbitrary

from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import frames_s, movement_warning


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


def test_walking_users_move_by_up_to_a_part_of_the_range():
    ways = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        at_rest = arbitrary.draw(rng)
        scenario = arbitrary.with_velocity(at_rest, rng)
        assert not movement_warning(scenario)
        assert scenario.roi_size_m == at_rest.roi_size_m
        ways.append(scenario.user_speed_std_mps * frames_s(scenario)
                    * scenario.center_frequencies_hz[0] / SPEED_OF_LIGHT_MPS)
    assert min(ways) < 0.1
    assert max(ways) > 10


def test_rows_of_walking_users_contain_the_velocity():
    figures = arbitrary.measure(9, 4, walking=True)
    assert ', user_speed_std_mps ' in figures['about']
    assert len(figures['velocity_squares']) == len(figures['squares']) == 4


def test_all_surfaces_of_a_site_face_its_region():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        bounds_m = arbitrary.draw(rng).roi_bounds_m
        other = arbitrary.placed(arbitrary.draw(rng), bounds_m, rng)
        low, high = other.roi_bounds_m
        assert low[0] > 0
        places = other.pose.to_surface(rng.uniform(*bounds_m, (10, 3)))
        assert (low - 1e-9 <= places).all() and (places <= high + 1e-9).all()


def test_several_surfaces_locate_the_users_of_one_region():
    figures = arbitrary.measure(5, 8, n_surfaces=2)
    assert figures['about'].count('GHz') == 2
    assert figures['fix'][0] == 100
    assert 0.2 < figures['nees'][0] < 3


@pytest.mark.parametrize('name', arbitrary.UNKNOWN)
def test_descriptions_name_what_is_unknown(name):
    scenario = arbitrary.draw(np.random.default_rng(9))
    assert (f', {name} ' in arbitrary.about(scenario)) == bool(getattr(scenario, name))
