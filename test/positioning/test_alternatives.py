"""Users without a direct path."""

import dataclasses

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.model.gaussian import log_evidence_of_level
from rhs_isac_ros.model.impairments import draw_impairments
from rhs_isac_ros.model.los import draw_blocked
from rhs_isac_ros.model.hall import CONDITIONS, MultipathEstimate
from rhs_isac_ros.positioning import Tracker, make_estimator
from rhs_isac_ros.positioning.alternatives import BLOCKED_LIMIT

N_USERS = 200
DECLARED = dataclasses.replace(Scenario(), blocked_probability=0.3)


def signals_of(scenario, codebook, seed):
    """Positions, signals and which users are blocked."""
    positions = Scenario().sample_positions(N_USERS, np.random.default_rng(0))
    received = MeasurementModel(scenario, codebook).sample(
        positions, np.random.default_rng(seed))
    # As in `MeasurementModel.sample`, after the impairments.
    rng = np.random.default_rng(seed)
    draw_impairments(scenario, N_USERS, rng)
    blocked = draw_blocked(scenario, N_USERS, rng)
    return positions, received, blocked


@pytest.mark.parametrize('median_db', [0.0, -6.0])
def test_the_evidence_of_a_level_is_the_average_over_it(median_db):
    energy, n, std_db = np.array([0.1, 50.0, 5e3]), 512, 12.0
    db = np.linspace(-60, 60, 200_001)
    level = db * np.log(10) / 10
    expected = logsumexp(
        -energy[:, None] * np.exp(-level) - n * level + norm(median_db, std_db).logpdf(db),
        axis=1) + np.log(db[1] - db[0])
    np.testing.assert_allclose(
        log_evidence_of_level(energy, n, std_db, median_db), expected, atol=0.05)


def test_blocked_users_have_the_multipath_alone(shipped):
    """Signals of users in sight do not depend on the probability."""
    positions, received, blocked = signals_of(DECLARED, shipped, 1)
    assert 0.2 < blocked.mean() < 0.4
    plain = MeasurementModel(Scenario(), shipped).sample(positions, np.random.default_rng(1))
    model = MeasurementModel(Scenario(), shipped)
    np.testing.assert_array_equal(received[~blocked], plain[~blocked])
    np.testing.assert_allclose(
        (plain - received)[blocked], model.mean(positions[blocked]), atol=1e-12)
    element_by_element = simulate_received(
        DECLARED, shipped, positions, np.random.default_rng(1))
    before = simulate_received(Scenario(), shipped, positions, np.random.default_rng(1))
    np.testing.assert_array_equal(
        (element_by_element != before).any(axis=(1, 2)), blocked)


@pytest.mark.slow
@pytest.mark.parametrize('reject_outside', [False, True])
@pytest.mark.parametrize(('name', 'change'), [
    ('bayes', {}), ('ml', {}), ('bayes', {'user_gain_std_db': 3.0}),
    ('bayes', {'carrier_offset_std_hz': 500.0, 'phase_std_rad': 6.3}),
    ('bayes', {'element_error_rms': 0.05})], ids=['bayes', 'ml', 'gain', 'carrier', 'elements'])
def test_the_probability_of_blocked_users_is_calibrated(name, reject_outside, change, shipped):
    scenario = dataclasses.replace(DECLARED, **change)
    _, received, blocked = signals_of(scenario, shipped, 2)
    estimate = make_estimator(
        name, scenario, shipped, reject_outside=reject_outside).estimate(received)
    # Multipath alone may also be a weak direct path from outside.
    outside = np.nan_to_num(estimate.outside_probability)
    probability = estimate.blocked_probability + outside
    if not reject_outside:
        assert probability.mean() == pytest.approx(blocked.mean(), abs=0.12)
        assert (estimate.fix <= (probability <= BLOCKED_LIMIT)).all()
        reasons = [reason for reason in estimate.reason if reason]
        assert np.mean([one.startswith('blocked: probability') for one in reasons]) > 0.5
    assert probability[blocked].mean() > probability[~blocked].mean() + 0.3


def test_the_inflation_of_a_survey_makes_no_user_in_sight_blocked(shipped):
    """The residuals are weaker than the inflated covariance, as those of a blocked user are."""
    declared = Scenario(multipath_to_los_db=-8.0)
    scenario = dataclasses.replace(declared, blocked_probability=0.3)
    _, received, blocked = signals_of(scenario, shipped, 3)
    model, inflation = MeasurementModel(scenario, shipped), 6.0
    n_bands, n_rows = model.shape
    fields = declared.fields()
    assumed = dataclasses.replace(scenario, multipath=MultipathEstimate(
        declared.multipath_to_los_db + 10 * np.log10(inflation), declared.delay_spread_s,
        declared.angular_spread_deg, np.array(model.radiation),
        np.zeros((n_bands, n_rows, n_rows), complex), {name: fields[name] for name in CONDITIONS},
        {'inflation': inflation, 'level_std_db': 1.0}))
    estimate = make_estimator('bayes', assumed, shipped).estimate(received)
    assert estimate.fix[~blocked].mean() > 0.95
    assert estimate.fix[blocked].mean() < 0.1


def test_without_the_field_users_are_in_sight(shipped, table1_estimator):
    _, received, _ = signals_of(DECLARED, shipped, 2)
    assert np.isnan(table1_estimator.estimate(received).blocked_probability).all()


def test_a_track_continues_through_a_blockage(shipped):
    scenario, rng = Scenario(), np.random.default_rng(4)
    declared = dataclasses.replace(scenario, blocked_probability=0.1)
    tracker = Tracker(make_estimator('bayes', declared, shipped))
    model = MeasurementModel(scenario, shipped)
    places = np.linspace([7.0, -1.0, 0.0], [7.0, 1.4, 0.0], 13)
    received = model.sample(places, rng)
    received[8:12] -= model.mean(places[8:12])
    found = [tracker.update(0.2 * step, one) for step, one in enumerate(received)]
    lost = [one for one in found[8:12] if one.blocked_probability > BLOCKED_LIMIT]
    assert lost
    for one in found[6:]:
        assert one.fix
        assert one.reason == ''
    errors = [np.linalg.norm(one.mean - place) for one, place in zip(found, places, strict=True)]
    assert max(errors[8:]) < 1.0
    assert np.trace(found[11].covariance) > np.trace(found[7].covariance)
    # Without signals in sight, the track ends.
    late = tracker.update(20.0, received[9])
    assert late.reason.startswith('blocked') and not late.fix
