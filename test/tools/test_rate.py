"""Rates against NumPy."""

import re

import numpy as np
import pytest

from rhs_isac_ros.tools.topic import Rate


def numbers(report):
    return [float(number) for number in re.findall(r'[\d.]+(?=s| |\n|$)', report)]


def test_the_layout_is_that_of_ros2():
    rate = Rate(100)
    for time_s in (1.0, 1.25, 1.75):
        rate.add(round(time_s * 1e9))
    assert rate.report() == (
        'average rate: 2.667\n\tmin: 0.250s max: 0.500s std dev: 0.12500s window: 2')


def test_the_rate_within_the_window_matches_numpy():
    times_s = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 50))
    rate = Rate(10)
    for time_s in times_s:
        rate.add(round(time_s * 1e9))
    steps_s = np.diff(times_s[-11:])
    assert numbers(rate.report()) == pytest.approx(
        [1 / steps_s.mean(), steps_s.min(), steps_s.max(), steps_s.std(), 10], abs=1e-3)


def test_the_report_is_empty_without_a_new_message():
    rate = Rate(10)
    assert rate.report() == ''
    rate.add(1)
    assert rate.report() == ''
    rate.add(2)
    assert rate.report()
    assert rate.report() == ''


def test_a_clock_that_goes_back_restarts_the_measurement():
    rate = Rate(10)
    for time_ns in (10**9, 2 * 10**9, 5, 5 + 10**8):
        rate.add(time_ns)
    report = rate.report()
    assert report.startswith('average rate: 10.000')
    assert report.endswith('window: 1')
