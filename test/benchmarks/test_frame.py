"""The frame of the benchmarks: errors of estimates, intervals and tables."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from parts import frame

from rhs_isac_ros.positioning import Estimate

PROGRAM = '''
import functools
import multiprocessing

from parts import frame
from scipy.special import chdtri


@functools.cache
def level():
    """Return a value that each process computes once."""
    return 0.05


def radius(size):
    """Return a quantile."""
    return {'squared': float(chdtri(size, level()))}


if __name__ == '__main__':
    options = frame.benchmark_parser('program', '', has_jobs=True).parse_args()
    print(frame.measured(options, 'program', radius, {'one': {'size': 1}, 'three': {'size': 3}}))
'''


@pytest.mark.parametrize('name', frame.SYSTEMS)
def test_the_systems_that_benchmarks_compare_share_the_spectrum_of_the_paper(name):
    """The plans of `bandplan`, and the traced channels of `channels`, have this spectrum."""
    scenario, _ = frame.system(name)
    assert all(2.5e9 <= one <= 3e9 for one in scenario.center_frequencies_hz)


def test_errors_are_those_of_the_fixes():
    mean = np.array([[1.0, 0, 0], [np.nan] * 3, [0, 6.0, 0]])
    covariance = np.stack([np.eye(3), np.full((3, 3), np.nan), 4 * np.eye(3)])
    fixes = frame.Fixes.of(Estimate(mean, covariance, ('', 'residual', '')), np.zeros((3, 3)))
    assert fixes.fix.tolist() == [True, False, True]
    assert fixes.squared.tolist() == [1.0, 36.0]
    np.testing.assert_allclose(fixes.normalised, [1.0, 9.0])
    # The 95 % quantile of the distribution chi-square with three degrees of freedom is 7.81.
    assert fixes.inside.tolist() == [True, False]
    figures = fixes.figures()
    assert figures['without_fix'][0] == pytest.approx(100 / 3)
    assert figures['fix'][0] == pytest.approx(200 / 3)
    assert (figures['covered'][0], figures['nees'][0]) == (50.0, 5.0)
    assert figures['mse_m2'][0] == figures['rms_m'][0]**2 == 18.5
    none = frame.Fixes(np.zeros(2, bool), np.empty(0), np.empty(0)).figures()
    assert none.pop('fix')[0] == 0
    assert none.pop('without_fix')[0] == 100
    assert set(none.values()) == {None}


def test_the_interval_of_a_mean_covers_it_and_resamples_groups():
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(100), 10)
    samples = rng.normal(size=100)[group]
    value, low, high = frame.mean_interval(samples, group)
    assert value == pytest.approx(samples.mean())
    assert low < value < high
    # A standard error of 0.1, which single samples would understate.
    assert 0.3 < high - low < 0.5
    _, low, high = frame.mean_interval(samples)
    assert high - low < 0.2
    assert frame.mean_interval(samples[:0]) is None
    ratio, low, high = frame.mean_interval(2 * samples**2, relative_to=samples**2)
    assert (ratio, low, high) == pytest.approx((2.0, 2.0, 2.0))


def test_a_table_shows_numbers_texts_and_intervals(capsys):
    table = frame.Table(['name'], {'value': ('v', 1), 'other': ('o', 2)})
    assert table.row('a', v=1.25, unseen=1) == {'v': 1.25, 'unseen': 1}
    table.row('b', v='text', o=(1.0, 0.5, 1.75))
    assert capsys.readouterr().out.splitlines() == [
        '| name | value | other |', '| --- | --- | --- |', '| a | 1.2 | - |',
        '| b | text | 1.00 [0.50, 1.75] |']


def test_options_are_those_with_a_default():
    options = frame.benchmark_parser('name', 'About.', positions=20).parse_args(['--seed', '3'])
    assert (options.positions, options.seed, options.json) == (20, 3, None)
    bare = frame.benchmark_parser('name', 'About.', default_seed=None).parse_args([])
    assert vars(bare) == {'json': None}


def test_single_estimates_are_stacked():
    class Shifted:
        def estimate(self, received):
            return Estimate(received + 1, 2 * np.eye(3), 'no' * int(received[0]), 4.0, 5.0)

    received = np.array([[0.0, 1, 2], [1.0, 2, 3]])
    estimate, times_s = frame.estimate_singly(Shifted(), received)
    np.testing.assert_array_equal(estimate.mean, received + 1)
    np.testing.assert_array_equal(estimate.covariance, [2 * np.eye(3)] * 2)
    assert estimate.reason == ('', 'no')
    assert (estimate.residual.tolist(), estimate.expected_residual.tolist()) == ([4, 4], [5, 5])
    assert times_s.shape == (2, 2)


def test_a_function_runs_in_a_new_process():
    assert frame.in_new_process(pow, 2, 5) == 32
    assert frame.peak_mib() > 1


def test_jobs_of_a_program_use_its_caches_and_ufuncs_in_other_processes(tmp_path):
    program = tmp_path / 'programs' / 'program.py'
    program.parent.mkdir()
    program.write_text(PROGRAM)
    path = os.pathsep.join([str(tmp_path), str(frame.CONFIG.parent / 'scripts'), *sys.path])
    done = subprocess.run(
        [sys.executable, str(program), '--jobs', '2'], cwd=tmp_path, capture_output=True,
        text=True, timeout=240, check=False, env={**os.environ, 'PYTHONPATH': path})
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(
        r"{'one': {'squared': 3.8414\d*}, 'three': {'squared': 7.8147\d*}}\n", done.stdout)
