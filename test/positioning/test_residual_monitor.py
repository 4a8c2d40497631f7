"""The running test of the residuals' energy."""

import math

import numpy as np
import pytest
from scipy.stats import gamma

from rhs_isac_ros.positioning.residual_monitor import MIN_FIXES, WINDOW, ResidualMonitor


def energies(n, scale=1.0, n_measurements=64):
    """Residuals of a model whose covariance is too small by a factor."""
    return scale * gamma(n_measurements - 1.5).rvs(n, random_state=np.random.default_rng(0))


def filled(values):
    monitor = ResidualMonitor(64)
    for value in values:
        monitor.add(float(value))
    return monitor


def test_residuals_of_the_model_cause_no_warning():
    monitor = ResidualMonitor(64)
    for value in energies(2000):
        monitor.add(float(value))
        assert monitor.warning == ''


def test_a_single_measurement_can_be_judged():
    monitor = ResidualMonitor(1)
    for value in gamma(0.5).rvs(WINDOW, random_state=np.random.default_rng(0)):
        monitor.add(float(value))
        assert monitor.warning == ''
    for _ in range(WINDOW):
        monitor.add(10.0)
    assert monitor.warning != ''


def test_slightly_larger_residuals_cause_a_warning_after_some_fixes():
    values = energies(WINDOW, 1.1)
    assert filled(values[:MIN_FIXES]).warning == ''
    warning = filled(values).warning
    assert warning.startswith('residual energy: ')
    assert f'on average over {WINDOW} fixes, expected 62.5' in warning


def test_few_residuals_are_not_judged():
    assert filled([1e6] * (MIN_FIXES - 1)).warning == ''
    assert filled([1e6] * MIN_FIXES).warning != ''


@pytest.mark.parametrize('window', [-1, 0, MIN_FIXES - 1])
def test_a_window_without_verdicts_is_an_error(window):
    with pytest.raises(ValueError, match=f'^window: {window}, expected at least {MIN_FIXES}$'):
        ResidualMonitor(64, window)
    assert ResidualMonitor(64, MIN_FIXES).warning == ''


def test_old_residuals_are_forgotten():
    monitor = filled([*energies(WINDOW, 2.0), *energies(WINDOW)])
    assert monitor.warning == ''
    monitor = filled(energies(WINDOW, 2.0))
    monitor.clear()
    assert monitor.warning == ''


@pytest.mark.parametrize('n_fixes', [MIN_FIXES, WINDOW])
def test_the_limits_are_quantiles(n_fixes):
    for limit, sign in ((gamma(n_fixes * 62.5).isf(0.5e-6), 1),
                        (gamma(n_fixes * 62.5).ppf(0.5e-6), -1)):
        assert filled([limit / n_fixes * (1 - 1e-6 * sign)] * n_fixes).warning == ''
        assert filled([limit / n_fixes * (1 + 1e-6 * sign)] * n_fixes).warning != ''


def test_estimates_without_a_residual_are_ignored():
    monitor = filled([math.nan] * WINDOW)
    assert monitor.warning == ''
    for value in energies(WINDOW, 2.0):
        monitor.add(float(value))
        monitor.add(math.nan)
    assert monitor.warning != ''
