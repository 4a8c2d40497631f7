"""Simulated pairs of positions and signals."""

import numpy as np
import pytest

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import simulate_pairs


@pytest.fixture(scope='module')
def setting(random_beams):
    scenario = Scenario(n_subbands=2, n_frames=2, elements_per_side=3, n_feeds=2)
    return scenario, random_beams(scenario, np.random.default_rng(0))


def test_a_sequence_is_the_same_however_it_is_divided(setting):
    positions, received = simulate_pairs(*setting, 1500, 3)
    for size in (1, 400, 512, 700):
        parts = [simulate_pairs(*setting, min(size, 1500 - first), 3, first)
                 for first in range(0, 1500, size)[:3]]
        for whole, part in zip((positions, received), zip(*parts, strict=True), strict=True):
            part = np.concatenate(part)
            assert part.tobytes() == whole[:len(part)].tobytes()


def test_pairs_do_not_change_between_versions(setting):
    """The expected positions are the first draws of NumPy's generator."""
    scenario = setting[0]
    rng = np.random.default_rng([11, 10, 0])
    expected = rng.uniform(*scenario.roi_bounds_m, (512, 3))
    np.testing.assert_array_equal(simulate_pairs(*setting, 5, 11)[0], expected[:5])


def test_seeds_and_chunks_give_different_pairs(setting):
    first, second = simulate_pairs(*setting, 1024, 0)[0], simulate_pairs(*setting, 1024, 1)[0]
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 2048


def test_signals_are_those_of_the_positions(setting):
    model, (positions, received) = MeasurementModel(*setting), simulate_pairs(*setting, 512, 0)
    white = model.whiten(received - model.mean(positions))
    # The standard deviation of the mean of 4096 squares is 0.016.
    assert np.mean(np.abs(white)**2) == pytest.approx(1, abs=0.065)


@pytest.mark.parametrize(('arguments', 'message'), [
    ((-1, 0), 'n: -1, expected 0 or more'), ((1, -2), 'seed: -2'), ((1, 0, -3), 'first: -3')])
def test_negative_numbers_are_errors(setting, arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate_pairs(*setting, *arguments)


def test_no_pairs_are_empty_and_another_codebook_is_an_error(setting, small):
    positions, received = simulate_pairs(*setting, 0, 0)
    assert (positions.shape, received.shape) == ((0, 3), (0, 2, 4))
    with pytest.raises(CodebookError):
        simulate_pairs(setting[0], small.codebook, 1, 0)
