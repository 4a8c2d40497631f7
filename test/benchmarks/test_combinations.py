"""Combinations of capabilities: which cells there are, what they measure, and what is refused."""

import argparse
import json

import numpy as np
import pytest
from benchmarks import combinations
from benchmarks.combinations import INGREDIENTS, Setting, cell, change, measure, pairs

from rhs_isac_ros.model import Pose

N = len(INGREDIENTS)


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def test_each_ingredient_meets_each_other_one_and_stands_alone():
    assert len({frozenset(pair) for pair in pairs(())}) == N * (N + 1) // 2
    assert len(list(pairs(['site']))) == N
    assert len(list(pairs(['site', 'thin']))) == 2 * N - 1


def test_declarations_of_two_ingredients_add_up():
    setting = INGREDIENTS['gain'](INGREDIENTS['waveform'](Setting()))
    assert setting.declared['user_gain_std_db'] == 3
    assert setting.declared['timing_std_s'] == 5e-7


@pytest.mark.parametrize(('pair', 'reason'), [
    (('band_phases', 'waveform'), 'band_phase_std_rad: 0.3 rad, expected at least'),
    (('track', 'prior'), 'Tracker.update takes no prior')])
def test_the_software_refuses_a_combination_with_a_reason(pair, reason, rng):
    assert cell(*pair, 1, rng)['refused'].startswith(reason)


@pytest.mark.parametrize(('other', 'n'), [('track', 2), ('prior', 1)])
def test_a_site_has_positions_with_a_track_or_a_prior(other, n, rng, monkeypatch):
    monkeypatch.setitem(INGREDIENTS, 'track', change(n_cycles=2))
    found = cell('site', other, n, rng)
    assert (found['n'], found['fix'][0], found['dimensions']) == (n, 100, 3)
    assert found['mse_m2'][0] < 1


def test_walking_users_meet_each_ingredient_alone(rng, monkeypatch):
    chosen = list(pairs([], walking=True))
    assert chosen == [(name, name) for name in INGREDIENTS]
    assert cell('library', 'library', 1, rng, True)['refused'].startswith('config/lab_walk.yaml')
    setting = INGREDIENTS['carrier'](INGREDIENTS['thin'](Setting())).walking()
    assert setting.declared['carrier_offset_std_hz'] == 1
    (path,) = combinations.inside_path(setting, rng)
    assert path.shape == (6,)
    assert np.linalg.norm(path[3:]) == pytest.approx(1)
    np.testing.assert_allclose(setting.bounds_m, [[2, -2, 0], [6, 2, 0]])


@pytest.mark.parametrize('site', combinations.SITES)
def test_surfaces_of_a_site_have_the_region_in_front(site):
    setting = Setting(site=site, has_site=True)
    centre = setting.bounds_m.mean(axis=0)
    for pose, (_, height_m, tilt) in zip(setting.poses, combinations.SITES[site], strict=True):
        place = pose.to_surface(centre + [0, 0, height_m])
        np.testing.assert_allclose(place, [10, 0, 0], atol=1e-8)
        assert pose.rotation[2, 0] == pytest.approx(np.sin(np.radians(tilt)))
    assert Setting().poses == [Pose()]


def test_users_outside_count_only_for_wrong_fixes():
    found = cell('thin', 'outside', 12, np.random.default_rng(3))
    assert found['n'] == 12
    assert found['dimensions'] == 2
    assert found['fix'][0] == 100
    assert found['wrong_fix'] is not None
    assert found['mse_m2'][0] < 1


def test_sites_have_no_positions_of_users_outside(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(combinations, 'SITES', {'sixty': combinations.SITES['sixty']})
    monkeypatch.setattr(combinations, 'PLANS', ('bandplan',))
    options = argparse.Namespace(
        positions=8, seed=4, sites=True, json=tmp_path / 'sites.json', jobs=1, dask=None,
        walking=False)
    measure(options)
    found = json.loads(options.json.read_text())['bandplan']['sixty']
    assert (found['fix'][0], found['wrong_fix'][0]) == (100, 0)


def test_finished_cells_are_kept_until_all_are_measured(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    options = argparse.Namespace(
        positions=5, seed=1, only=['site'], json=tmp_path / 'cells.json', jobs=1, dask=None,
        walking=False, site='three', sites=False)
    measured = []

    def counted(one, other, n, rng, walking, site):
        assert site == 'three'
        measured.append((one, other))
        if len(measured) == 3:
            raise KeyboardInterrupt
        return {'refused': 'no'}
    monkeypatch.setattr(combinations, 'cell', counted)
    with pytest.raises(KeyboardInterrupt):
        measure(options)
    results = measure(options)
    assert len(measured) == N + 1
    assert results['site']['track'] == results['track']['site']
    assert '| site + track | no |' in capsys.readouterr().out
    assert json.loads(options.json.read_text()) == results


def test_the_table_has_coverage_and_nees_of_each_pair_once():
    found = {'in_region': [95.2, 90, 98], 'nees': [2.94, 2, 4]}
    results = {'site': {'site': found, 'track': found},
               'track': {'site': found, 'track': {'refused': 'no'}}}
    assert combinations.matrix(results).splitlines() == [
        ',site,track', 'site,95; 2.9,', 'track,95; 2.9,refused']
    assert combinations.reasons(results) == {'track + track': 'no'}
