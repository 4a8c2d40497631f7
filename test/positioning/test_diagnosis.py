"""The likely cause of signals without a position."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import Estimate, make_estimator
from rhs_isac_ros.positioning.alternatives import Blocked, describe_doubts
from rhs_isac_ros.positioning.diagnosis import LEVEL, SPREAD, Diagnosis
from rhs_isac_ros.positioning.innovation_test import MIN_FIXES, WINDOW

N_USERS = 100


def one(found, row):
    """Return one of several estimates."""
    return Estimate(*(getattr(found, field.name)[row] for field in dataclasses.fields(Estimate)))


def diagnosis_of(found):
    diagnosis = Diagnosis()
    for row in range(len(found.mean)):
        diagnosis.add(one(found, row))
    return diagnosis


def located(world, codebook, estimator):
    rng = np.random.default_rng(5)
    positions = rng.uniform(*Scenario().roi_bounds_m, (N_USERS, 3))
    return estimator.estimate(simulate_received(world, codebook, positions, rng))


@pytest.mark.parametrize(('change', 'cause'), [
    ({'multipath_to_los_db': Scenario().multipath_to_los_db + 6}, LEVEL),
    ({'delay_spread_s': 2 * Scenario().delay_spread_s}, SPREAD),
    ({'angular_spread_deg': 3 * Scenario().angular_spread_deg}, SPREAD)],
    ids=['level', 'delays', 'angles'])
def test_wrong_levels_and_spreads_of_the_multipath_are_told_apart(
        change, cause, shipped, table1_estimator):
    found = located(dataclasses.replace(Scenario(), **change), shipped, table1_estimator)
    assert not found.fix.any()
    values = diagnosis_of(found).status(True)
    assert values['no_fix.cause'] == cause
    assert values['no_fix.share'] == f'{N_USERS} of {N_USERS}'


def test_blocked_users_are_the_cause_unless_the_residuals_deviate(shipped):
    declared = dataclasses.replace(Scenario(), blocked_probability=0.3)
    found = located(declared, shipped, make_estimator('bayes', declared, shipped))
    diagnosis = diagnosis_of(found)
    values = diagnosis.status(False)
    assert values['no_fix.cause'] == Blocked.reason
    assert float(values['probability.blocked']) == pytest.approx(0.3, abs=0.12)
    assert 'probability.outside' not in values
    assert diagnosis.status(True)['no_fix.cause'] in (LEVEL, SPREAD)


def test_signals_of_the_model_have_no_cause(shipped, table1_estimator):
    assert diagnosis_of(located(Scenario(), shipped, table1_estimator)).status(False) == {}


def test_few_residuals_leave_the_reason_as_the_cause():
    diagnosis, nothing = Diagnosis(), (np.full(3, np.nan), np.full((3, 3), np.nan))
    for _ in range(MIN_FIXES - 1):
        diagnosis.add(Estimate(*nothing, 'residual energy: 9, expected at most 5', 9.0, 3.0))
    assert diagnosis.status(True)['no_fix.cause'] == 'residual energy'
    for _ in range(WINDOW):
        diagnosis.add(Estimate(np.zeros(3), np.eye(3)))
    assert diagnosis.status(True) == {}


def test_doubts_are_described_from_one_percent_on():
    place = np.zeros(3), np.eye(3)
    estimate = Estimate(*place, outside_probability=0.004, blocked_probability=0.12)
    assert describe_doubts(estimate) == 'blocked 12 %'
    assert describe_doubts(Estimate(*place)) == ''
