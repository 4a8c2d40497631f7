"""Bias and covariance of estimators that assume another model than the true one."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb, misspecified
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator


@pytest.fixture(scope='module')
def plan(pytestconfig):
    """The band plan with so little multipath that ranges are hardly ever ambiguous."""
    config = pytestconfig.rootpath / 'config'
    scenario = Scenario.from_yaml(config / 'bandplan.yaml')
    return (dataclasses.replace(scenario, multipath_to_los_db=-25.0),
            Codebook.load(config / 'codebook_bandplan.yaml'))


@pytest.fixture(scope='module')
def positions(plan):
    return plan[0].sample_positions(30, np.random.default_rng(0))


@pytest.fixture(scope='module')
def estimator(plan):
    return make_estimator('ml', *plan)


def compare(assumed, true, codebook, positions):
    return misspecified(MeasurementModel(assumed, codebook), MeasurementModel(true, codebook),
                        positions)


@pytest.mark.slow
def test_without_a_wrong_assumption_it_is_the_bound(plan, positions):
    scenario, codebook = plan
    result = compare(scenario, scenario, codebook, positions)
    np.testing.assert_allclose(result.bias, 0, atol=1e-9)
    np.testing.assert_allclose(result.mse_m2, crlb(scenario, codebook, positions), rtol=1e-9)
    assert result.valid.mean() > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(('field', 'value', 'has_bias'), [
    ('angular_spread_deg', 14.0, False), ('refractive_index', 2.102, True)])
def test_where_valid_it_is_the_error_of_the_estimator(
        plan, estimator, positions, field, value, has_bias):
    scenario, codebook = plan
    true = dataclasses.replace(scenario, **{field: value})
    result = compare(scenario, true, codebook, positions)
    assert result.valid.sum() >= 15
    assert (np.linalg.norm(result.bias, axis=1) > 1e-4).any() == has_bias
    model = MeasurementModel(true, codebook)
    chosen = np.flatnonzero(result.valid)[:15]
    places = np.repeat(positions[chosen], 40, axis=0)
    estimate = estimator.estimate(model.sample(places, np.random.default_rng(1)))
    assert estimate.fix.mean() > 0.99
    squares = np.sum((estimate.mean - places)[estimate.fix]**2, axis=1)
    assert np.mean(squares) == pytest.approx(result.mse_m2[chosen].mean(), rel=0.1)
    bias = (estimate.mean - places).reshape(len(chosen), 40, 3)
    own = np.sqrt(np.trace(result.covariance[chosen], axis1=1, axis2=2) / 40)
    error = np.linalg.norm(np.nanmean(bias, axis=1) - result.bias[chosen], axis=1)
    assert np.mean(error / own) < 1.5


def test_it_does_not_claim_validity_where_ranges_are_ambiguous(shipped):
    """Two bands repeat every 0.6 m, so that most errors are not local."""
    scenario = Scenario()
    true = dataclasses.replace(scenario, angular_spread_deg=20.0)
    places = scenario.sample_positions(20, np.random.default_rng(0))
    assert not compare(scenario, true, shipped, places).valid.any()


@pytest.mark.parametrize(('before_m', 'behind_m', 'valid'), [
    (0.3, 0.3, True), (0.6, 0.3, False), (0.3, 0.6, False)])
def test_an_ambiguity_on_the_border_of_the_region_counts(shipped, before_m, behind_m, valid):
    scenario = Scenario(
        multipath_to_los_db=-6.0, roi_center_m=(5 + (behind_m - before_m) / 2, 0, 0),
        roi_size_m=(before_m + behind_m, 6, 6))
    assert compare(scenario, scenario, shipped, np.array([[5, 0.3, 0.2]])).valid == [valid]


@pytest.mark.slow
def test_it_does_not_claim_validity_where_signals_are_refused(plan, estimator, positions):
    scenario, codebook = plan
    loud = dataclasses.replace(scenario, user_gain=2.0)
    result = compare(scenario, loud, codebook, positions)
    assert not result.valid.any()
    estimate = estimator.estimate(
        MeasurementModel(loud, codebook).sample(positions, np.random.default_rng(0)))
    assert estimate.fix.mean() < 0.2


def test_models_that_do_not_fit_are_refused(plan, positions):
    scenario, codebook = plan
    with pytest.raises(ValueError, match='true: a scenario with nuisance parameters'):
        compare(scenario, dataclasses.replace(scenario, phase_std_rad=1.0), codebook, positions)
    with pytest.raises(ValueError, match='positions: '):
        compare(scenario, scenario, codebook, positions[0])
