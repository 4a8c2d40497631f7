"""A sweep as a function: codebooks of the settings, points in order, and the table."""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, CodebookError, random_codebook
from rhs_isac_ros.experiments import sweep as sweep_module
from rhs_isac_ros.experiments.sweep import Sweep, run_sweep, table
from rhs_isac_ros.experiments.sweep_settings import FIELDS, parse_axis, settings_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.system import System

pytest.importorskip('joblib')
pytest.importorskip('tqdm')

BASE = Scenario(elements_per_side=4, n_subbands=2, n_feeds=2, n_frames=1)


def sweep_over(*texts, codebook='random', **options):
    settings = settings_of(BASE, [parse_axis(text) for text in texts], codebook, 'bayes')
    return Sweep(BASE, settings, **{'measures': ['crlb'], 'n_positions': 300, **options})


@pytest.fixture
def file(tmp_path):
    path = tmp_path / 'book.yaml'
    random_codebook(BASE, np.random.default_rng(0)).save(path)
    return str(path)


def test_points_have_the_order_of_settings_and_measures(tmp_path, file):
    sweep = sweep_over('max_power_w=1e-3,1e-4', codebook=file, measures=['crlb', 'crlb_median'])
    points = run_sweep(sweep, tmp_path / 'jobs', 1)
    assert [(point.setting.scenario.max_power_w, point.measure) for point in points] == [
        (1e-4, 'crlb'), (1e-4, 'crlb_median'), (1e-3, 'crlb'), (1e-3, 'crlb_median')]
    book = Codebook.load(file)
    positions, _ = System(BASE, book).pairs(300, 0)
    assert points[2].interval.value == pytest.approx(crlb(BASE, book, positions).mean(), rel=1e-6)
    assert points[2].codebook_ids == (book.id,)
    # A file has the power of each setting.
    assert points[0].codebook_ids != points[2].codebook_ids
    assert points[0].interval.value > points[2].interval.value


def test_the_interval_covers_several_codebooks(tmp_path):
    points = [run_sweep(sweep_over('n_frames=1', repeats=repeats), tmp_path, 1)[0]
              for repeats in (1, 3)]
    assert [len(point.codebook_ids) for point in points] == [1, 3]
    assert points[0].codebook_ids[0] == points[1].codebook_ids[0]


def test_the_optimisation_uses_all_values_by_default():
    sweep = sweep_over('n_frames=1,2', 'multipath_to_los_db=0,-10', codebook='optimize')
    assert len({job.name for s in sweep.settings for job in sweep.designs(s)}) == 4
    for setting in sweep.settings:
        assert sweep.scenario_of_codebook(setting) == setting.scenario


def test_the_optimisation_may_use_base_values():
    texts = ['n_frames=1,2', 'multipath_to_los_db=0,-10', 'noise_psd_dbm_hz=-174,-160']
    sweep = sweep_over(*texts, codebook='optimize', optimize_for=['noise_psd_dbm_hz'])
    for setting in sweep.settings:
        assert sweep.scenario_of_codebook(setting) == dataclasses.replace(
            setting.scenario, multipath_to_los_db=0.0)
    none = sweep_over(*texts, codebook='optimize', optimize_for=[])
    assert len({job.name for s in none.settings for job in none.designs(s)}) == 2


def test_a_file_that_does_not_fit_is_an_error_before_the_start(file):
    with pytest.raises(CodebookError, match=r'book.yaml: analog: shape .*; setting n_frames = 2'):
        sweep_over('n_frames=1,2', codebook=file)
    with pytest.raises(CodebookError, match='amplitude_levels = 2 .*; setting amplitude_levels'):
        sweep_over('amplitude_levels=2', codebook=file)


def test_the_table_has_every_field_of_the_scenario(tmp_path, file):
    sweep = sweep_over('user_gain=0.5,1', f'codebook=random,{file}', seed=7)
    rows = list(csv.DictReader(io.StringIO(
        table(sweep, run_sweep(sweep, tmp_path / 'jobs', 1)))))
    assert len(rows) == 4
    assert set(FIELDS) < set(rows[0])
    assert [row['codebook'] for row in rows] == ['random', file] * 2
    for row in rows:
        assert Scenario(**{
            name: parse_axis(f'{name}={row[name]}').values[0][0] for name in FIELDS}).id == (
                row['scenario'])
        assert float(row['low']) < float(row['value']) < float(row['high'])
        assert (row['measure'], row['unit'], row['estimator']) == ('crlb', 'm²', 'bayes')
        assert (row['positions'], row['seed'], row['objective']) == ('300', '7', '')


def test_the_table_names_the_origin_of_the_codebooks(tmp_path, file, monkeypatch):
    monkeypatch.setattr(sweep_module, 'design', lambda scenario, **_: random_codebook(
        Scenario(**scenario), np.random.default_rng(0)).to_parameters())
    sweep = sweep_over('multipath_to_los_db=-10', f'codebook=optimize,random,{file}',
                       optimize_for=[], n_positions=4)
    rows = list(csv.DictReader(io.StringIO(table(sweep, run_sweep(sweep, tmp_path / 'a', 1)))))
    origins = [row['codebook_scenario'] for row in rows]
    assert Scenario(**json.loads(origins[0])) == BASE
    assert Scenario(**json.loads(origins[1])) == dataclasses.replace(
        BASE, multipath_to_los_db=-10.0)
    assert origins[2] == ''
    assert [row['steps'] for row in rows] == ['300', '', '']


@pytest.mark.parametrize(('options', 'expected'), [
    ({'measures': ['fame']}, "measures: 'fame', expected some of crlb"),
    ({'n_positions': 0}, 'n_positions: 0, expected at least 1'),
    ({'n_positions': 1e3}, 'n_positions: 1000.0, expected an integer'),
    ({'optimize_for': ['n_frame']}, "optimize_for: 'n_frame', expected names of fields"),
    ({'repeats': 0}, 'repeats: 0, expected at least 1')])
def test_an_error_names_what_is_wrong(options, expected):
    with pytest.raises(ValueError, match=expected):
        sweep_over('n_frames=1', **options)


def test_more_positions_repeat_only_the_new_blocks(tmp_path, monkeypatch):
    made = []
    # What a function refers to is a source of its results, unlike what a method changes.
    record = made.append
    monkeypatch.setattr(sweep_module, 'evaluate', lambda first, n, **_: record(
        (first, n)) or {'crlb_m2': [1.0] * n})
    run_sweep(sweep_over('n_frames=1', n_positions=500), tmp_path, 1)
    run_sweep(sweep_over('n_frames=1', n_positions=600), tmp_path, 1)
    assert made == [(0, 250), (250, 250), (500, 100)]


def test_the_coverage_of_a_plane_is_that_of_its_two_dimensions(tmp_path, monkeypatch):
    """Errors of two standard normal coordinates; in three dimensions, 98 % would be inside."""
    class Normal:
        def estimate(self, received):
            n = len(received)
            errors = np.random.default_rng(0).standard_normal((n, 3)) * [1.0, 1.0, 0.0]
            places = places_of[0] + errors
            return Estimate(places, np.tile(np.diag([1.0, 1.0, 1e-10]), (n, 1, 1)), ('',) * n)

    flat = dataclasses.replace(BASE, roi_size_m=(10.0, 10.0, 0.0))
    book = random_codebook(flat, np.random.default_rng(0))
    places_of = [System(flat, book).pairs(2000, 1)[0]]
    monkeypatch.setattr(sweep_module, '_estimator', lambda *_: Normal())
    inside = sweep_module.evaluate(
        'error', flat.changes(), book.to_parameters(), 1, 0, 2000)['inside']
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)
