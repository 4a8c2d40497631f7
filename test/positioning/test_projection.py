"""The projection of signals onto what means fill, compared with all signals."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.codebook.unoptimised import random_codebook
from rhs_isac_ros.model import Scenario, geometry
from rhs_isac_ros.positioning import make_estimator, projection
from rhs_isac_ros.system import System

WIDE = dataclasses.replace(Scenario(), n_subbands=64, subband_width_hz=30e3,
                           subband_spacing_hz=300e3)


@pytest.fixture(scope='module')
def system():
    return System(WIDE, random_codebook(WIDE, np.random.default_rng(1))).prepare()


@pytest.fixture(scope='module')
def model(system):
    return projection.projected(system)


@pytest.fixture(scope='module')
def shots(system):
    positions = WIDE.sample_positions(30, np.random.default_rng(5))
    return positions, system.sample(positions, np.random.default_rng(6))


def test_the_likelihood_is_that_of_all_signals(system, model, shots):
    positions, received = shots
    assert model.basis.shape[2] < 0.2 * system.n_whitened / system.scenario.n_bands

    def energies(one):
        means, slopes = one.mean_and_jacobian(positions, whitened=True)
        residual = one.whiten(received) - means
        return (np.sum(np.abs(residual)**2, axis=(1, 2)),
                np.einsum('pibn,pbn->pi', slopes.conj(), residual).real)

    for exact, found in zip(energies(system), energies(model), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-4, atol=1e-3)


def test_means_outside_of_the_basis_have_hardly_any_energy(system, model):
    positions = WIDE.sample_positions(50, np.random.default_rng(7))
    all_of_it, kept = (np.sum(np.abs(projection.white_means(one, positions))**2, axis=(0, 2))
                       for one in (system, model))
    assert all_of_it.mean() > 50
    assert np.mean(all_of_it - kept) < 2 * projection.MAX_LOSS + 1e-9 * all_of_it.mean()


def test_estimates_are_those_from_all_signals(monkeypatch, system, shots):
    _, received = shots
    few = make_estimator('bayes', WIDE, system.codebook, reject_outside=True)
    monkeypatch.setattr(projection, '_FEW', 10**9)
    exact = make_estimator('bayes', WIDE, system.codebook, reject_outside=True)
    one, other = few.estimate(received[:10]), exact.estimate(received[:10])
    offset = one.mean - other.mean
    sigmas = np.sqrt(np.einsum('pi,pij,pj->p', offset, np.linalg.inv(other.covariance), offset))
    # A mode at the limit of what counts may be left out.
    assert np.median(sigmas) < 1e-3
    assert sigmas.max() < 0.1
    np.testing.assert_allclose(one.residual, other.residual, atol=0.01)
    np.testing.assert_allclose(one.expected_residual, other.expected_residual, atol=0.02)
    np.testing.assert_allclose(one.outside_probability, other.outside_probability, atol=1e-3)


def test_a_fix_does_not_depend_on_the_batch(system, shots):
    _, received = shots
    estimator = make_estimator('bayes', WIDE, system.codebook)
    together = estimator.estimate(received[:5])
    for n in range(5):
        np.testing.assert_allclose(
            estimator.estimate(received[n]).mean, together.mean[n], rtol=0, atol=1e-9)


@pytest.mark.parametrize('ends_m', [None, np.array([1.0, 60.0])])
def test_gains_are_interpolated_from_few_frequencies(ends_m):
    weights = projection.interpolation(WIDE, ends_m)
    n_nodes = weights.shape[1]
    assert n_nodes < 32
    nodes = dataclasses.replace(WIDE, n_subbands=n_nodes,
                                subband_spacing_hz=WIDE.bandwidth_hz / n_nodes)
    frequencies_hz, nodes_hz = (
        geometry.subband_frequencies_hz(one)[0] for one in (WIDE, nodes))
    for distance_m in ends_m if ends_m is not None else (5.2, 11.0):
        delay_s = distance_m / projection.SPEED_OF_LIGHT_MPS
        gains, at_nodes = (np.exp(-2j * np.pi * delay_s * one)
                           for one in (frequencies_hz, nodes_hz))
        np.testing.assert_allclose(weights @ at_nodes, gains, atol=1e-7)


@pytest.mark.parametrize('changes', [
    {'n_subbands': 8}, {'user_gain_std_db': 1.0}, {'timing_std_s': 2e-8},
    {'element_error_rms': 0.05}], ids=str)
def test_signals_that_a_projection_does_not_suit_stay_as_they_are(changes):
    scenario = dataclasses.replace(WIDE, **changes)
    system = System(scenario, random_codebook(scenario, np.random.default_rng(1)))
    assert projection.projected(system) is system
