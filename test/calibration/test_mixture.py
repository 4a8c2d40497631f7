"""The posterior of elements that work or have failed, from a Gaussian likelihood."""

import dataclasses
import itertools

import numpy as np
import pytest

from rhs_isac_ros.calibration.mixture import SurfacePrior, surface_posterior, without_data

PRIOR = SurfacePrior(0.05, 0.1, 0.5)
N_ELEMENTS, N_BANDS = 3, 1
SIZE = 2 * N_ELEMENTS + N_BANDS
BAND_RMS = np.full((2, N_BANDS), 0.3)
# Prior mean and variance of each number, real and then imaginary parts.
MEAN = np.array([1.0] * 3 + [0.5] * 3 + [0.0] * 8)
VARIANCE = np.array([0.05**2 / 2] * 3 + [1 / 12 + 0.05**2 / 6] * 3 + [0.09]
                    + [0.05**2 / 2] * 3 + [0.05**2 / 6] * 3 + [0.09])


def likelihood(seed, n_rows, failed):
    """Information, shift, design and data of a random linear model of real numbers."""
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(n_rows, 2 * SIZE)) * 3
    values = np.where(used(failed), MEAN + np.sqrt(VARIANCE) * rng.normal(size=2 * SIZE), 0.0)
    data = design @ values + rng.normal(size=n_rows)
    return design.T @ design, design.T @ data, design, data


def used(failed):
    """Which numbers are not zero given the states, bool [2 P]."""
    one = np.concatenate([~failed, failed, [True]])
    return np.concatenate([one, one])


def exact(design, data, share=0.1):
    """Complex mean and covariance, and probabilities, by enumeration of all states."""
    weights, means, covariances, states = [], [], [], []
    for state in itertools.product((False, True), repeat=N_ELEMENTS):
        failed = np.array(state)
        chosen = used(failed)
        columns = design[:, chosen]
        spread = columns * VARIANCE[chosen] @ columns.T + np.eye(len(data))
        residual = data - columns @ MEAN[chosen]
        prior = np.sum(np.where(failed, np.log(share), np.log(1 - share)))
        weights.append(prior - np.linalg.slogdet(spread)[1] / 2
                       - residual @ np.linalg.solve(spread, residual) / 2)
        gain = VARIANCE[chosen, None] * columns.T @ np.linalg.inv(spread)
        mean, covariance = np.zeros(2 * SIZE), np.zeros((2 * SIZE, 2 * SIZE))
        mean[chosen] = MEAN[chosen] + gain @ residual
        covariance[np.ix_(chosen, chosen)] = (
            np.diag(VARIANCE[chosen]) - gain @ columns * VARIANCE[chosen])
        means.append(mean)
        covariances.append(covariance)
        states.append(failed)
    shares = np.exp(np.array(weights) - max(weights))
    shares /= shares.sum()
    mean = shares @ means
    second = sum(share * (covariance + np.outer(one, one)) for share, one, covariance in zip(
        shares, means, covariances, strict=True))
    # From real and imaginary parts to complex numbers.
    parts = np.kron([1, 1j], np.eye(SIZE))
    covariance = parts @ (second - np.outer(mean, mean)) @ parts.conj().T
    return parts @ mean, covariance, shares @ np.array(states, float)


@pytest.mark.parametrize('share', [0.1, 0.4])
def test_without_data_the_posterior_is_the_prior(share):
    prior = dataclasses.replace(PRIOR, failed_element_share=share)
    computed = surface_posterior(
        np.zeros((2 * SIZE, 2 * SIZE)), np.zeros(2 * SIZE), prior, BAND_RMS,
        np.zeros(N_ELEMENTS, bool))
    mean, covariance, probability = exact(np.zeros((1, 2 * SIZE)), np.zeros(1), share)
    for posterior in (computed, without_data(prior, BAND_RMS, N_ELEMENTS)):
        np.testing.assert_allclose(posterior.mean, mean, atol=1e-12)
        np.testing.assert_allclose(posterior.covariance, covariance, atol=1e-12)
        np.testing.assert_allclose(posterior.failed_probability, probability)
        np.testing.assert_array_equal(posterior.failed, False)


@pytest.mark.parametrize('seed', range(8))
def test_with_informative_data_the_posterior_is_exact(seed):
    failed = np.random.default_rng(seed).uniform(size=N_ELEMENTS) < 0.4
    information, shift, design, data = likelihood(seed, 40, failed)
    posterior = surface_posterior(information, shift, PRIOR, BAND_RMS, np.zeros(3, bool))
    mean, covariance, probability = exact(design, data)
    np.testing.assert_array_equal(posterior.failed, failed)
    np.testing.assert_allclose(posterior.failed_probability, probability, atol=1e-3)
    np.testing.assert_allclose(posterior.mean, mean, atol=1e-3)
    np.testing.assert_allclose(posterior.covariance, covariance, atol=1e-3)


def test_one_ambiguous_element_is_averaged_over_its_states():
    """Exactly, if the others are certain: an element stuck close to its usual amplitude."""
    *_, design, data = likelihood(3, 40, np.zeros(3, bool))
    # No row depends on the first element.
    design[:, [0, N_ELEMENTS, SIZE, SIZE + N_ELEMENTS]] = 0.0
    information, shift = design.T @ design, design.T @ data
    posterior = surface_posterior(information, shift, PRIOR, BAND_RMS, np.zeros(3, bool))
    mean, covariance, probability = exact(design, data)
    assert posterior.failed_probability[0] == pytest.approx(0.1)
    np.testing.assert_allclose(posterior.failed_probability, probability, atol=1e-3)
    np.testing.assert_allclose(posterior.mean, mean, atol=2e-3)
    np.testing.assert_allclose(posterior.covariance, covariance, atol=2e-3)


def test_the_start_does_not_matter_with_informative_data():
    information, shift, *_ = likelihood(1, 40, np.array([True, False, False]))
    one, other = (surface_posterior(information, shift, PRIOR, BAND_RMS, start)
                  for start in (np.zeros(3, bool), np.ones(3, bool)))
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-9)


@pytest.mark.parametrize('values', [
    {'element_error_rms': -0.1}, {'failed_element_share': 0.9}, {'band_gain_rms': np.nan}])
def test_a_prior_out_of_range_is_named(values):
    (name,) = values
    with pytest.raises(ValueError, match=f'{name}: .*, expected 0 to'):
        SurfacePrior(**{'element_error_rms': 0.0, 'failed_element_share': 0.0} | values)
