"""Tasks of a researcher: the short examples of the documentation run, and do what they say."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from rhs_isac_ros.model import PathChannel

EXAMPLES = Path(__file__).parents[2] / 'docs' / 'examples'
TASKS = ('own_estimator', 'own_impairment', 'own_board', 'disc', 'curved_panel',
         'comb_pilots', 'nr_grid', 'sionna_channel', 'matlab_channel', 'own_jobs', 'own_sweep')


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example in an empty folder; return the lines that it prints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLES)

    def run_example(name, *arguments):
        monkeypatch.setattr(sys, 'argv', [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / f'{name}.py'), run_name='__main__')
        return capsys.readouterr().out.splitlines()
    return run_example


def numbers(lines):
    return np.array([float(word) for line in lines for word in line.strip('[]').split()])


@pytest.mark.parametrize('name', TASKS)
def test_a_task_takes_at_most_25_lines(name):
    lines = (EXAMPLES / f'{name}.py').read_text(encoding='utf-8').splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 25


def test_an_own_estimator_locates_users(run):
    (error,) = numbers(run('own_estimator'))
    assert error < 3


def test_an_own_impairment_costs_accuracy(run):
    without, declared = numbers(run('own_impairment'))
    assert without < declared < 2 * without


def test_an_own_board_is_optimised(run):
    first, last = numbers(run('own_board'))
    assert last < 0.6 * first


def test_a_disc_is_optimised(run):
    (bound,) = numbers(run('disc'))
    assert 0.05 < bound < 0.2


def test_normals_of_a_curved_panel_lower_bounds_at_its_sides(run):
    facing_x, outward = numbers(run('curved_panel')).reshape(2, 3)
    assert (outward[[0, 2]] < 0.95 * facing_x[[0, 2]]).all()
    assert outward[1] > facing_x[1]


def test_a_wider_comb_has_a_lower_bound(run):
    bounds = [float(line.split()[-2]) for line in run('comb_pilots')]
    assert bounds[0] > bounds[1] > bounds[2]


def test_users_are_located_with_an_nr_grid(run):
    n_subbands, error = numbers(run('nr_grid'))
    assert (n_subbands, error < 0.5) == (72, True)


def test_paths_of_sionna_give_signals(run):
    assert run('sionna_channel', Path(__file__).parents[1] / 'data' / 'sionna.npz') == [
        '2 users, 38 paths, signals (2, 2, 32)']


def test_users_of_a_channel_from_matlab_are_located(run, tmp_path):
    users = np.random.default_rng(0).uniform([6, -2, -0.5], [10, 2, 0.5], (5, 3))
    distance = np.linalg.norm(users, axis=1, keepdims=True)
    scipy.io.savemat(tmp_path / 'hall.mat', {
        'users': users, 'a': 299_792_458 / (4 * np.pi * 2.75e9 * distance),
        'src': users[:, None], 'n': np.zeros((5, 1)), 'f0': 2.75e9})
    assert PathChannel.load(tmp_path / 'hall.mat').users.shape == (5, 3)
    assert np.median(numbers(run('matlab_channel', tmp_path / 'hall.mat'))) < 0.5


def test_own_jobs_are_kept(run, tmp_path):
    pytest.importorskip('joblib')
    first = run('own_jobs')
    bounds = [float(line.split()[0]) for line in first]
    assert (np.diff(np.reshape(bounds, (2, 3)), axis=0) > 0).all()
    assert len([*(tmp_path / 'results' / 'own').iterdir()]) == 6
    assert run('own_jobs') == first


def test_a_sweep_uses_an_own_estimator_in_other_processes(run):
    pytest.importorskip('joblib')
    lines = run('own_sweep')
    assert len(lines) == 8
    assert sum('rmse' in line for line in lines) == 4
