"""Combinations of many sub-bands, compared with all signals."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb_of
from rhs_isac_ros.codebook.unoptimised import STARTS, random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.model import compression as c

# The bandwidth of 3276 sub-carriers of 30 kHz.
WIDE = dataclasses.replace(
    Scenario(), center_frequencies_hz=(2.75e9,), n_subbands=256, subband_width_hz=30e3,
    subband_spacing_hz=98.28e6 / 256, n_frames=2, frame_duration_s=36e-6)


@pytest.mark.parametrize('beams', STARTS)
def test_combinations_lose_less_than_a_millionth_of_a_nat(beams):
    model = MeasurementModel(WIDE, STARTS[beams](WIDE, np.random.default_rng(1), None))
    covariance, means = model.covariance()[0], model.mean(
        WIDE.sample_positions(40, np.random.default_rng(2)))[:, 0]
    exact = np.sum(means.conj() * np.linalg.solve(covariance, means.T).T, axis=1).real
    white = model.whiten(means[:, None])
    assert white.shape[-1] < 0.8 * means.shape[-1]
    lost = exact - np.sum(np.abs(white)**2, axis=(1, 2))
    assert exact.mean() > 100
    assert np.abs(lost).max() < 1e-6


def test_the_covariance_of_the_combinations_is_exact():
    model = MeasurementModel(WIDE, random_codebook(WIDE, np.random.default_rng(1)))
    functions = c.subband_functions(WIDE)
    expanded = c.expand_functions(functions, np.eye(2 * functions.shape[1])[None])[0]
    np.testing.assert_allclose(
        c.combined_covariance(WIDE, model.radiation, functions)[0] / WIDE.noise_power_w,
        expanded.conj().T @ model.covariance()[0] @ expanded / WIDE.noise_power_w, atol=1e-5)


def test_the_whitener_whitens_combined_signals():
    model = MeasurementModel(WIDE, random_codebook(WIDE, np.random.default_rng(1)))
    signals = np.random.default_rng(1).normal(size=(3, *model.shape))
    np.testing.assert_allclose(
        model.whiten(signals), np.einsum('bnr,pbr->pbn', model.whitener, signals), rtol=1e-6,
        atol=1e-6 * np.abs(model.whiten(signals)).max())
    np.testing.assert_allclose(model.whitener[0] @ model.root[0], np.eye(model.n_whitened),
                               atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize('simulate', [
    lambda model, positions, rng: simulate_received(WIDE, model.beams, positions, rng),
    MeasurementModel.sample], ids=['simulate_received', 'sample'])
def test_simulated_signals_have_the_distribution_of_the_model(simulate):
    model = MeasurementModel(WIDE, random_codebook(WIDE, np.random.default_rng(1)))
    positions = WIDE.sample_positions(40, np.random.default_rng(2))
    received = simulate(model, positions, np.random.default_rng(3))
    residual = model.whiten(received - model.mean(positions))
    assert np.mean(np.abs(residual)**2) == pytest.approx(1, abs=4 / np.sqrt(residual.size))
    # All measurements, of which combinations contain some.
    covariance = model.covariance()[0]
    white = np.linalg.solve(
        np.linalg.cholesky(covariance), (received - model.mean(positions))[:, 0].T)
    assert np.mean(np.abs(white)**2) == pytest.approx(1, abs=4 / np.sqrt(white.size))


def test_combinations_do_not_change_the_bound(monkeypatch):
    beams = random_codebook(WIDE, np.random.default_rng(1))
    positions = WIDE.sample_positions(5, np.random.default_rng(2))
    combined = crlb_of(MeasurementModel(WIDE, beams), positions)
    monkeypatch.setattr(MeasurementModel, '_functions', None)
    np.testing.assert_allclose(
        combined, crlb_of(MeasurementModel(WIDE, beams), positions), rtol=1e-6)


def test_few_subbands_are_not_combined():
    assert c.subband_functions(Scenario()) is None
    assert c.subband_functions(dataclasses.replace(WIDE, n_subbands=128)) is None


def test_weights_that_change_from_subband_to_subband_are_not_combined():
    beams = random_codebook(WIDE, np.random.default_rng(1))
    phases = np.exp(2j * np.pi * np.random.default_rng(2).random(beams.digital.shape))
    rough = MeasurementModel(WIDE, dataclasses.replace(beams, digital=beams.digital * phases))
    assert MeasurementModel(WIDE, beams).n_whitened < np.prod(rough.shape) == rough.n_whitened
