"""Arrays of users: what counts as a number and as a position, wherever one is given."""

import numpy as np
import pytest

from rhs_isac_ros.bounds import PairwiseErrorCost, average_crlb, crlb, misspecified
from rhs_isac_ros.bounds.average import AverageCrlb
from rhs_isac_ros.bounds.range_ambiguity import range_confusion_error_of
from rhs_isac_ros.calibration import Pilots, survey
from rhs_isac_ros.codebook import Codebook, CodebookError, optimize
from rhs_isac_ros.link import (
    Beamformer,
    actual_capacity,
    capacity,
    capacity_report,
    choose_beam,
    expected_capacities,
    steer,
)
from rhs_isac_ros.model import ElementErrors, MeasurementModel, mobility, simulate_received
from rhs_isac_ros.model.arrays import checked_positions, log_size, numbers, untied
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.model.los import los_and_derivative, los_gain
from rhs_isac_ros.positioning import SignalError, make_estimator

GOOD = np.array([[8.0, 1.0, 0.2]])
BEHIND = {'behind': [[-8.0, 1.0, 0.2]], 'on the plane': [[0.0, 1.0, 0.2]]}
MALFORMED = {
    'one dimension': [8.0, 1.0, 0.2], 'two coordinates': [[8.0, 1.0]],
    'infinite': [[8.0, np.inf, 0.2]],
    'complex': np.array([[8.0, 1j, 0.2]]), 'text': np.array([['8', '1', '0.2']]),
    'masked': np.ma.array(GOOD, mask=[[False, True, False]]), 'unmasked': np.ma.array(GOOD),
    'masked entry': [[8.0, np.ma.masked, 0.2]], 'objects': np.array([[8.0, None, 0.2]]),
    'ragged': [[8.0, 1.0], [0.2]], 'not finite': [[8.0, np.nan, 0.2]],
    'enormous': [[1e200, 1.0, 0.2]], 'enormous and negative': [[8.0, -1e200, 0.2]]}


@pytest.fixture(scope='module')
def doors(small):
    """Functions that take positions [1, 3], by name."""
    scenario, codebook = small.scenario, small.codebook
    model, rng = MeasurementModel(scenario, codebook), np.random.default_rng(0)
    beam = steer(scenario, GOOD[0])
    received = simulate_received(scenario, codebook, GOOD, rng)
    return {
        'crlb': lambda p: crlb(scenario, codebook, p),
        'average_crlb': lambda p: average_crlb(scenario, codebook, p),
        'mean': model.mean, 'mean_and_jacobian': model.mean_and_jacobian,
        'covariance_at': model.covariance_at, 'sample': lambda p: model.sample(p, rng),
        'simulate_received': lambda p: simulate_received(scenario, codebook, p, rng),
        'misspecified': lambda p: misspecified(model, model, p),
        'optimize': lambda p: optimize(scenario, p, max_steps=1),
        'survey': lambda p: survey(scenario, codebook, p, received),
        'pilots': lambda p: Pilots(codebook, p, received),
        'los_gain': lambda p: los_gain(scenario, p, 0),
        'los_and_derivative': lambda p: los_and_derivative(scenario, p, 0),
        'AverageCrlb': lambda p: AverageCrlb(scenario, p, 1e-3),
        'first of a pair': lambda p: PairwiseErrorCost(scenario, p, GOOD),
        'second of a pair': lambda p: PairwiseErrorCost(scenario, GOOD, p, tolerance=0),
        'range_confusion_error_of': lambda p: range_confusion_error_of(model, p, rng),
        'capacity': lambda p: capacity(scenario, beam, p),
        'actual_capacity': lambda p: actual_capacity(scenario, beam, p),
        'steer': lambda p: steer(scenario, p[0]),
        'choose_beam': lambda p: choose_beam(scenario, p[0]),
        'capacity_report': lambda p: capacity_report(scenario, beam, p[0]),
        'expected_capacities': lambda p: expected_capacities(scenario, [beam], p[0], np.eye(3)),
        'static': lambda p: mobility.Static(p[0]),
        'waypoints': lambda p: mobility.Waypoints(p, 1.0),
        'walk': lambda p: mobility.RandomWalk(scenario, 1.0, rng, p[0])}


@pytest.mark.parametrize('kind', [*BEHIND, 'on an element'])
def test_positions_behind_the_surface_are_errors(doors, small, kind):
    bad = BEHIND.get(kind, element_positions(small.scenario)[:1])
    for call in doors.values():
        with pytest.raises(ValueError, match=r'^(positions?|mean|start): x = .* expected x > 0'):
            call(bad)


@pytest.mark.parametrize('kind', MALFORMED)
def test_malformed_positions_are_errors(doors, kind):
    for call in doors.values():
        with pytest.raises(ValueError, match=r'(?s)^(positions?|mean|start): .*expected '):
            call(MALFORMED[kind])


def test_positions_are_accepted_as_lists_and_integers():
    np.testing.assert_array_equal(checked_positions([(8, 1, 0)]), [[8.0, 1.0, 0.0]])
    assert checked_positions(np.empty((0, 3))).shape == (0, 3)
    with pytest.raises(ValueError, match=r'^positions: shape \(3,\), expected \[N, 3\]$'):
        checked_positions([8.0, 1.0, 0.2])


def masked(array):
    return np.ma.array(array, mask=np.arange(array.size).reshape(array.shape) == 1)


def test_a_codebook_consists_of_numbers(small):
    analog, digital = small.codebook.analog, small.codebook.digital
    for changed in (analog * np.exp(1j * np.pi / 3), analog.astype(str), analog.astype(object),
                    masked(analog)):
        with pytest.raises(CodebookError, match='^analog: .*expected '):
            Codebook(changed, digital)
    for changed in (digital.astype(str), masked(digital)):
        with pytest.raises(CodebookError, match='^digital: .*expected '):
            Codebook(analog, changed)
    assert Codebook(np.rint(analog).astype(int), digital).analog.dtype == float


def test_signals_and_beams_are_numbers(small):
    scenario, codebook = small.scenario, small.codebook
    received = simulate_received(scenario, codebook, GOOD, np.random.default_rng(0))
    estimator = make_estimator('bayes', scenario, codebook)
    for changed in (masked(received), received.astype(str), received.astype(object)):
        with pytest.raises(SignalError, match='^received: .*expected '):
            estimator.estimate(changed)
        with pytest.raises(ValueError, match='^received: .*expected '):
            Pilots(codebook, GOOD, changed)
    beam = steer(scenario, GOOD[0])
    with pytest.raises(ValueError, match='^analog: a masked array'):
        capacity(scenario, Beamformer(masked(beam.analog), beam.digital), GOOD)
    with pytest.raises(ValueError, match='^covariance: complex numbers, expected real'):
        expected_capacities(scenario, [beam], GOOD[0], 1j * np.eye(3))


def test_element_errors_are_numbers():
    with pytest.raises(ValueError, match='^stuck: complex numbers, expected real'):
        ElementErrors(np.ones(2), np.array([np.nan, 0.5j]))
    with pytest.raises(ValueError, match='^gains: a masked array'):
        ElementErrors(masked(np.ones(2)), np.full(2, np.nan))


def test_numbers_are_converted_without_a_copy_or_loss():
    array = np.array([1.0, 2.0])
    assert numbers('x', array) is array
    assert numbers('x', [1, True], complex).dtype == complex
    assert np.isnan(numbers('x', [np.nan], finite=False)).all()


def test_of_values_that_are_equal_up_to_rounding_the_first_is_the_smallest():
    values = np.array([0.1 + 0.2, 0.3, 0.3 - 1e-15, 0.2999])
    for one in (values, -values):
        assert np.argmin(untied(one[:3])) == 0
    assert np.argsort(untied(np.stack([values, values]))).tolist() == [[3, 0, 1, 2]] * 2


def test_a_box_without_extent_along_an_axis_has_an_area():
    assert log_size(np.array([[0, 0, 1], [2, 3, 1]])) == pytest.approx(np.log(6))
    assert log_size(np.array([[0, 0, 1], [2, 3, 1]]), 0.5) == pytest.approx(np.log(3))
