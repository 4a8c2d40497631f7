"""What every estimator does, whatever its method."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    Network,
    SignalError,
    make_estimator,
)
from rhs_isac_ros.system import System

SCENARIO = Scenario(n_subbands=2, elements_per_side=4, roi_center_m=(4, 0, 0),
                    roi_size_m=(1, 1, 0.5))
# Numbers of real inputs and of hidden units.
N_INPUTS, N_HIDDEN = 32, 5


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(0))


@pytest.fixture(scope='module')
def received(codebook):
    return System(SCENARIO, codebook).pairs(40, 1)[1]


@pytest.fixture(scope='module')
def options(codebook, received):
    """Options of each estimator; the network has random weights."""
    rng = np.random.default_rng(2)
    network = Network(
        np.zeros(N_INPUTS), np.full(N_INPUTS, np.abs(received).std()),
        rng.normal(size=(N_INPUTS, N_HIDDEN)), np.zeros(N_HIDDEN),
        0.01 * rng.normal(size=(N_HIDDEN, 3)), np.zeros(3), np.array(SCENARIO.roi_center_m),
        np.diag([0.3, 0.2, 0.1]), np.array(1e9),
        about={'codebook': codebook.id, 'scenario': SCENARIO.changes()})
    return {'neural': {'model_file': network}}


@pytest.fixture(scope='module', params=ESTIMATORS)
def estimator(request, codebook, options):
    return make_estimator(request.param, SCENARIO, codebook, **options.get(request.param, {}))


def test_its_name_is_that_of_its_entry(estimator):
    assert ESTIMATORS[estimator.name] is type(estimator)


def test_covariances_are_symmetric_and_positive_definite(estimator, received):
    estimate = estimator.estimate(received)
    assert estimate.fix.all()
    assert estimate.mean.shape == (40, 3)
    assert estimate.covariance.shape == (40, 3, 3)
    np.testing.assert_allclose(
        estimate.covariance, np.swapaxes(estimate.covariance, 1, 2), rtol=1e-12, atol=1e-15)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_a_shot_has_the_same_estimate_alone_as_in_a_batch(estimator, received):
    batch = estimator.estimate(received)
    for n in range(0, len(received), 7):
        single = estimator.estimate(received[n])
        assert single.mean.shape == (3,)
        assert single.covariance.shape == (3, 3)
        assert (single.reason, single.fix) == ('', True)
        np.testing.assert_allclose(single.mean, batch.mean[n], rtol=0, atol=1e-9)
        np.testing.assert_allclose(single.covariance, batch.covariance[n], rtol=0, atol=1e-9)


def test_an_empty_batch_gives_empty_estimates(estimator, received):
    estimate = estimator.estimate(received[:0])
    assert estimate.mean.shape == (0, 3)
    assert estimate.covariance.shape == (0, 3, 3)
    assert estimate.reason == ()


@pytest.mark.parametrize(('signals', 'message'), [
    (np.zeros((2, 7)), r'^received: shape \(2, 7\), expected \[2, 8\] or \[N, 2, 8\]'),
    (np.zeros(16), r'^received: shape \(16,\), expected '),
    (np.full((2, 8), np.nan), '^received: not finite, expected ')])
def test_invalid_signals_are_errors(estimator, signals, message):
    with pytest.raises(SignalError, match=message):
        estimator.estimate(signals)


@pytest.mark.parametrize('name', ESTIMATORS)
def test_a_codebook_of_other_sizes_is_an_error(codebook, options, name):
    larger = dataclasses.replace(SCENARIO, n_frames=SCENARIO.n_frames + 1)
    with pytest.raises(CodebookError, match='analog: shape'):
        make_estimator(name, larger, codebook, **options.get(name, {}))


@pytest.mark.parametrize('declared', [
    {}, {'element_error_rms': 0.05}, {'failed_element_share': 0.03}, {'timing_std_s': 2e-8},
    {'user_speed_std_mps': 1.0, 'frame_duration_s': 5e-3}], ids=lambda one: '-'.join(one))
def test_a_copy_of_what_is_in_use_gives_the_same_results(codebook, declared):
    """Programs send estimators and systems to other processes, also after their first use."""
    system = System(dataclasses.replace(SCENARIO, **declared), codebook)
    places, received = system.pairs(2, 1)
    estimator = make_estimator('bayes', system.scenario, codebook)
    expected = estimator.estimate(received).mean
    bound, covariance = system.crlb(places), system.covariance_at(places)
    for copied in copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one)):
        np.testing.assert_array_equal(copied(estimator).estimate(received).mean, expected)
        np.testing.assert_array_equal(copied(system).crlb(places), bound)
        np.testing.assert_array_equal(copied(system).covariance_at(places), covariance)
