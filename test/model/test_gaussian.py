"""Information of Gaussian signals, and elimination of nuisance parameters from it."""

import numpy as np
import pytest
from scipy.special import ive, logsumexp
from scipy.stats import norm

from rhs_isac_ros.model import gaussian

N = 6


def test_quadratic_form_is_twice_the_real_part_of_the_products():
    whitened = np.random.default_rng(8).normal(size=(4, 2, 5, 2)) @ [1, 1j]
    expected = 2 * np.einsum('nga,nha->ngh', whitened.conj(), whitened).real
    # The memory layout does not matter.
    for layout in (whitened, np.asfortranarray(whitened)):
        np.testing.assert_allclose(
            gaussian.quadratic_form(layout), expected, rtol=1e-12, atol=1e-12)


@pytest.fixture(params=[1, 2, 5], ids='{} parameters'.format)
def joint(request):
    """Information [N, 3 + Q, 3 + Q] and gradient [N, 3 + Q] of random log-likelihoods."""
    size = 3 + request.param
    rng = np.random.default_rng(request.param)
    roots = rng.normal(size=(N, size, size + 2))
    return roots @ np.swapaxes(roots, 1, 2), rng.normal(size=(N, size))


def test_the_marginal_covariance_is_the_block_of_the_joint_inverse(joint):
    information, gradient = joint
    marginal = gaussian.marginalise(information, gradient)
    inverse = np.linalg.inv(information)
    np.testing.assert_allclose(
        np.linalg.inv(marginal.information), inverse[:, :3, :3], rtol=1e-8)
    np.testing.assert_array_equal(
        marginal.information, np.swapaxes(marginal.information, 1, 2))


def test_the_regression_follows_the_maximum_over_the_parameters(joint):
    """The gradient in the parameters vanishes wherever the other unknowns are."""
    information, gradient = joint
    marginal = gaussian.marginalise(information, gradient)
    fixed = np.random.default_rng(9).normal(size=(N, 3))
    others = marginal.offset + np.einsum('nqp,np->nq', marginal.regression, fixed)
    both = np.concatenate([fixed, others], axis=1)
    slope = gradient - np.einsum('nab,nb->na', information, both)
    np.testing.assert_allclose(slope[:, 3:], 0, atol=1e-9)
    np.testing.assert_allclose(
        slope[:, :3],
        marginal.gradient - np.einsum('nab,nb->na', marginal.information, fixed), atol=1e-9)


@pytest.mark.parametrize('n', [1, 2])
def test_the_volume_is_the_integral_over_the_parameters(n):
    """Of exp(g . x - x I x / 2) for other unknowns at several points, as a sum over a grid."""
    rng = np.random.default_rng(n)
    roots = rng.normal(size=(2, n + 2, n + 2))
    information = roots @ np.swapaxes(roots, 1, 2) + np.eye(n + 2)
    gradient = rng.normal(size=(2, n + 2))
    marginal = gaussian.marginalise(information, gradient, n)
    # Standard deviations do not exceed 1.
    axis = np.linspace(-12, 12, 961)
    others = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    for index in range(2):
        # Where the first unknowns are zero, the maximum over the others exceeds zero by this.
        highest = gradient[index, n:] @ marginal.offset[index] / 2
        for fixed in rng.normal(size=(3, n)):
            x = np.hstack([np.tile(fixed, (len(others), 1)), others])
            exponents = (x @ gradient[index]
                         - np.sum((x @ information[index]) * x, axis=1) / 2)
            integral = np.sum(np.exp(exponents)) * (axis[1] - axis[0])**2
            expected = (highest + marginal.gradient[index] @ fixed
                        - fixed @ marginal.information[index] @ fixed / 2
                        + marginal.log_volume[index] + np.log(2 * np.pi))
            assert np.log(integral) == pytest.approx(expected, abs=1e-9)


def test_without_parameters_nothing_changes():
    information, gradient = np.array([[[2.0, 1.0], [1.0, 3.0]]]), np.array([[4.0, 5.0]])
    marginal = gaussian.marginalise(information, gradient, 2)
    np.testing.assert_array_equal(marginal.information, information)
    np.testing.assert_array_equal(marginal.gradient, gradient)
    assert (marginal.regression.shape, marginal.offset.shape) == ((1, 0, 2), (1, 0))
    np.testing.assert_array_equal(marginal.log_volume, 0)


@pytest.mark.parametrize('median_db', [0.0, -6.0])
def test_the_evidence_of_a_level_is_the_average_over_it(median_db):
    energy, n, std_db = np.array([0.1, 50.0, 5e3]), 512, 12.0
    db = np.linspace(-60, 60, 200_001)
    level = db * np.log(10) / 10
    expected = logsumexp(
        -energy[:, None] * np.exp(-level) - n * level + norm(median_db, std_db).logpdf(db),
        axis=1) + np.log(db[1] - db[0])
    np.testing.assert_allclose(
        gaussian.log_evidence_of_level(energy[:, None], n, std_db, median_db), expected, atol=0.05)


def test_bessel_function():
    argument = np.concatenate([np.linspace(0, 5, 100), np.geomspace(5, 1e4, 50)])
    expected = argument + np.log(ive(0, argument))
    np.testing.assert_allclose(gaussian.log_bessel(argument), expected, rtol=0, atol=0.04)
