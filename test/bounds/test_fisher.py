"""Covariance, Fisher information and the bound."""

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb, fisher, fisher_information
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_derivative
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.model.surface import radiation_matrix


def test_correlation_matrices_are_the_vectors(case):
    over_frequency, over_time = fisher.correlation_matrices(case.scenario)
    np.testing.assert_allclose(over_frequency, case.vectors['K_f'], rtol=1e-8)
    np.testing.assert_allclose(over_time, case.vectors['K_t'], rtol=1e-8)
    assert not over_frequency.flags.writeable
    assert not over_time.flags.writeable


def test_covariance_is_the_vectors(case):
    patterns = radiation_matrix(case.scenario, case.codebook)
    covariance = fisher.covariance(case.scenario, patterns)
    scale = np.abs(case.vectors['cov']).max()
    np.testing.assert_allclose(covariance, case.vectors['cov'], rtol=1e-8, atol=1e-8 * scale)


def test_information_and_bound_are_the_vectors(case):
    positions = case.vectors['positions']
    information = fisher_information(case.scenario, case.codebook, positions)
    scale = np.abs(case.vectors['fim']).max()
    np.testing.assert_allclose(information, case.vectors['fim'], rtol=1e-8, atol=1e-10 * scale)
    bound = crlb(case.scenario, case.codebook, positions)
    assert bound.dtype == float
    np.testing.assert_allclose(bound, case.vectors['crlb'], rtol=1e-8)


@pytest.fixture(scope='module')
def faded(random_beams):
    """Three bands whose sub-bands and frames are far from fully correlated."""
    scenario = Scenario(
        center_frequencies_hz=(1.2e9, 2e9, 3.1e9), n_subbands=2, n_frames=3, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-3, noise_psd_dbm_hz=-150,
        roi_center_m=(3, 0, 0), roi_size_m=(2, 4, 2))
    return scenario, random_beams(scenario, np.random.default_rng(0))


def test_everything_is_the_plain_one_when_correlations_are_low(faded, plain):
    scenario, codebook = faded
    p = plain(scenario, codebook.analog, codebook.digital)
    spatial = multipath_covariance(scenario)
    positions = scenario.sample_positions(3, np.random.default_rng(1))
    covariance = fisher.covariance(scenario, radiation_matrix(scenario, codebook))
    for band in range(3):
        expected = p.covariance(band, spatial[band])
        np.testing.assert_allclose(
            covariance[band], expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    information = fisher_information(scenario, codebook, positions)
    for n, position in enumerate(positions):
        expected = p.information(position, spatial)
        np.testing.assert_allclose(
            information[n], expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(
        crlb(scenario, codebook, positions), p.crlb(positions, spatial), rtol=1e-8)


def test_mean_derivative_is_the_limit_of_differences_of_plain_means(faded, plain):
    scenario, codebook = faded
    p = plain(scenario, codebook.analog, codebook.digital)
    positions = scenario.sample_positions(2, np.random.default_rng(2))
    patterns, step = radiation_matrix(scenario, codebook), 1e-5
    for band in range(3):
        slopes = los_derivative(scenario, positions, band)
        derivative = fisher.mean_derivative(slopes, patterns[band])
        assert derivative.shape == (2, 3, 6)
        for u in range(3):
            shift = step * np.eye(3)[u]
            difference = (p.mean(positions + shift, band)
                          - p.mean(positions - shift, band)) / (2 * step)
            np.testing.assert_allclose(
                derivative[:, u], difference, rtol=0, atol=1e-7 * np.abs(derivative).max())


def test_whitening_matrices_whiten_the_vectors(case):
    whiteners = fisher.whitening_matrices(
        case.scenario, radiation_matrix(case.scenario, case.codebook))
    for whitener, covariance in zip(whiteners, case.vectors['cov'], strict=True):
        white = whitener @ covariance @ whitener.conj().T
        np.testing.assert_allclose(white, np.eye(len(white)), atol=1e-8)
        assert np.abs(np.triu(whitener, 1)).max() < 1e-12 * np.abs(whitener).max()


def test_factors_of_a_codebook_serve_all_positions(case, monkeypatch):
    factors = fisher.factor(case.scenario, case.codebook)

    def fail(*args):
        raise AssertionError('computed again')

    monkeypatch.setattr(fisher, 'whitening_matrices', fail)
    for n, position in enumerate(case.vectors['positions']):
        bound = crlb(case.scenario, case.codebook, position[None], factors)
        np.testing.assert_allclose(bound, case.vectors['crlb'][n], rtol=1e-8)


def test_bound_does_not_depend_on_the_blocks(case, monkeypatch):
    monkeypatch.setattr(fisher, '_BLOCK', 4)
    bound = crlb(case.scenario, case.codebook, case.vectors['positions'])
    np.testing.assert_allclose(bound, case.vectors['crlb'], rtol=1e-8)


def test_bound_is_infinite_where_signals_do_not_determine_the_position(small):
    """One complex signal has two real parts, and a position three coordinates."""
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=1,
                        n_feeds=1, elements_per_side=4)
    codebook = Codebook(np.full((1, 1, 16), 0.5), np.full((1, 1, 1, 1), np.sqrt(1e-3)))
    positions = scenario.sample_positions(50, np.random.default_rng(0))
    assert (crlb(scenario, codebook, positions) == np.inf).all()
    # Nothing reaches a surface that is switched off.
    dark = Codebook(np.zeros((1, 2, 16)), small.codebook.digital)
    assert (crlb(small.scenario, dark, positions) == np.inf).all()


def test_inverse_information_inverts_what_it_can():
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(3, 3, 3))
    information = roots @ np.swapaxes(roots, 1, 2)
    information[1] = roots[1][:, :2] @ roots[1][:, :2].T
    inverse = fisher.inverse_information(information)
    for n in (0, 2):
        np.testing.assert_allclose(inverse[n] @ information[n], np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(np.diag(inverse[1]), np.inf)


def test_no_positions_have_no_bounds(small):
    assert crlb(small.scenario, small.codebook, np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize('positions', [[10.0, 0.0, 0.0], [[10.0, 0.0]], [[np.nan, 0.0, 0.0]]])
def test_malformed_positions_are_errors(small, positions):
    for function in (crlb, fisher_information):
        with pytest.raises(ValueError, match='^positions: .*, expected '):
            function(small.scenario, small.codebook, np.array(positions))
