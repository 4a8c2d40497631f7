"""The whitened model."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.positioning.whitened import WhitenedModel


@pytest.fixture(scope='module')
def model(case) -> WhitenedModel:
    return WhitenedModel(case.scenario, case.codebook)


def test_whiten_makes_the_covariance_of_the_vectors_the_identity(case, model):
    """The columns of a square root of the covariance serve as signals."""
    n_bands, n_rows = case.vectors['cov'].shape[:2]
    roots = np.linalg.cholesky(case.vectors['cov'])
    columns = np.moveaxis(roots, 2, 0)
    white = model.whiten(columns)
    assert white.shape == (n_rows, n_bands, n_rows)
    for band in range(n_bands):
        root = white[:, band].T
        np.testing.assert_allclose(root @ root.conj().T, np.eye(n_rows), atol=1e-8)


def test_whitened_means_have_the_scalar_products_of_the_vectors(case, model):
    """Between any two positions: t1^H t2 is the sum of mu1^H Lambda^-1 mu2 over the bands."""
    t = model.mean(case.vectors['positions'])
    products = np.einsum('air,bir->ab', t.conj(), t)
    expected = sum(mean.conj() @ np.linalg.solve(covariance, mean.T) for mean, covariance
                   in zip(case.vectors['mean'], case.vectors['cov'], strict=True))
    np.testing.assert_allclose(products, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_log_likelihood_of_whitened_signals_is_the_gaussian_one(case, model):
    """Up to a constant, it is the log density of the signals before whitening."""
    rng = np.random.default_rng(0)
    n_bands, n_rows = case.vectors['cov'].shape[:2]
    noise = 1e-7 * rng.normal(size=(n_bands, n_rows, 2)) @ [1, 1j]
    received = case.vectors['mean'][:, 0] + noise
    exact = 0.0
    for y, means, covariance in zip(
            received, case.vectors['mean'], case.vectors['cov'], strict=True):
        residual = (y - means).T
        weighed = np.linalg.solve(covariance, residual)
        exact = exact - np.sum(residual.conj() * weighed, axis=0).real
    y, t = model.whiten(received[None])[0], model.mean(case.vectors['positions'])
    likelihood = np.sum(2 * (t.conj() * y).real - np.abs(t)**2, axis=(1, 2))
    np.testing.assert_allclose(
        likelihood - likelihood[0], exact - exact[0], rtol=1e-6, atol=1e-6 * np.abs(exact).max())


def test_jacobian_is_the_limit_of_differences_of_the_mean(case, model):
    positions, step = case.vectors['positions'], 1e-5
    mean, jacobian = model.mean_and_jacobian(positions)
    np.testing.assert_allclose(mean, model.mean(positions), rtol=1e-9, atol=1e-9)
    assert jacobian.shape == (len(positions), 3, *mean.shape[1:])
    for u in range(3):
        shift = step * np.eye(3)[u]
        difference = (model.mean(positions + shift) - model.mean(positions - shift)) / (2 * step)
        np.testing.assert_allclose(
            jacobian[:, u], difference, rtol=0, atol=1e-7 * np.abs(jacobian).max())


def test_derivatives_with_respect_to_other_coordinates_follow_the_chain_rule(case, model):
    positions = case.vectors['positions']
    by_coordinate = np.random.default_rng(0).normal(size=(len(positions), 3, 3))
    mean, jacobian = model.mean_and_jacobian(positions)
    same, by_other = model.mean_and_jacobian(positions, by_coordinate)
    np.testing.assert_array_equal(same, mean)
    expected = np.einsum('nabr,naq->nqbr', jacobian, by_coordinate)
    np.testing.assert_allclose(by_other, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_a_codebook_that_does_not_fit_is_an_error(small):
    with pytest.raises(CodebookError, match='analog: shape'):
        WhitenedModel(dataclasses.replace(small.scenario, elements_per_side=3), small.codebook)
