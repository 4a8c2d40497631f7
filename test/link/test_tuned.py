"""Beams on boards whose coefficients are not amplitudes."""

import numpy as np
import pytest

from rhs_isac_ros.link import capacity, steer
from rhs_isac_ros.link.tuned import TunedLink
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate

POSITION = np.array([8.0, 1.0, 0.2])
BOARDS = [('phase', 0), ('resonant', 0), ({'kind': 'states', 'states': [[1, 0], [-1, 0]]}, 2),
          ({'kind': 'states', 'states': [[1, 0], [0, 1], [-0.5, -0.5]]}, 3)]


@pytest.mark.parametrize(('board', 'levels'), BOARDS)
def test_no_single_tuning_increases_the_capacity_by_more_than_a_ten_thousandth(board, levels):
    scenario = Scenario(elements_per_side=5, board=board, amplitude_levels=levels)
    beam = steer(scenario, POSITION, 1)
    assert beam.band == 1
    assert np.sum(np.abs(beam.digital)**2) == pytest.approx(scenario.max_power_w)
    link = TunedLink.to(scenario, POSITION, 1, None)
    best = link.best_rate(beam.analog)[0, 0]
    bits = best / np.log(2) * scenario.subband_width_hz
    assert capacity(scenario, beam, POSITION[None])[0] == pytest.approx(bits)
    steps = np.linspace(0, 1, levels) if levels else [0.02, -0.02]
    for element in range(25):
        for step in steps:
            changed = beam.analog.copy()
            changed[element] = step if levels else np.clip(changed[element] + step, 0, 1)
            assert link.best_rate(changed)[0, 0] <= best * (1 + 1e-4)


def test_the_gradient_is_a_limit_of_differences_also_with_a_known_surface():
    scenario, rng = Scenario(elements_per_side=4, board='resonant'), np.random.default_rng(0)
    surface = SurfaceEstimate(
        1 + 0.1 * rng.normal(size=(16, 2)) @ [1, 1j], 0.1j * np.ones(16), [1.1, 0.9j],
        np.zeros((34, 0)), np.zeros(16))
    link = TunedLink.to(scenario, POSITION, 1, surface)
    tunings, step = rng.uniform(size=16), 1e-6 * rng.normal(size=16)
    _, gradient = link.rate_and_gradient(tunings)
    ((low, high),) = link.best_rate(tunings + np.array([[-1], [1]]) * step)
    assert (high - low) / 2 == pytest.approx(gradient @ step, rel=1e-5)


@pytest.mark.parametrize(('board', 'levels'), BOARDS)
def test_the_capacities_after_changes_of_single_tunings_are_those_of_their_tunings(board, levels):
    scenario = Scenario(elements_per_side=3, board=board, amplitude_levels=levels)
    rng, steps = np.random.default_rng(0), np.linspace(0, 1, levels or 3)
    surface = SurfaceEstimate(
        1 + 0.1 * rng.normal(size=(9, 2)) @ [1, 1j], 0.1j * np.ones(9), [1.1, 0.9j],
        np.zeros((20, 0)), np.zeros(9))
    link, tunings = TunedLink.to(scenario, POSITION, 1, surface), rng.choice(steps, 9)
    changed = np.tile(tunings, (9, len(steps), 1))
    changed[np.arange(9), :, np.arange(9)] = steps
    rates = link.rates_after_changes(tunings, steps)
    for one, rate in zip(changed, rates, strict=True):
        np.testing.assert_allclose(rate, link.best_rate(one)[0], rtol=1e-12)


def test_boards_with_more_freedom_reach_more_capacity():
    def reached(board, levels=0):
        scenario = Scenario(elements_per_side=6, board=board, amplitude_levels=levels)
        return capacity(scenario, steer(scenario, POSITION), POSITION[None])[0]

    amplitudes = reached('paper')
    assert reached('phase') > reached(*BOARDS[2]) > amplitudes
    assert reached('resonant') > amplitudes
