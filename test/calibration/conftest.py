"""A small scenario, surfaces with errors, and their pilots."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.calibration import Pilots
from rhs_isac_ros.model import MeasurementModel, Scenario, draw_surface

N_PILOTS = 60
SCENARIO = Scenario(
    elements_per_side=5, n_feeds=2, element_error_rms=0.03, failed_element_share=0.06)


@pytest.fixture(scope='session')
def scenario():
    return SCENARIO


@pytest.fixture(scope='session')
def beams(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(0))


@pytest.fixture(scope='session')
def damaged(beams):
    """Function that returns a surface with at least one failed element for a seed."""
    def make(seed):
        surface = draw_surface(SCENARIO, np.random.default_rng(seed))
        stuck = surface.stuck.copy()
        stuck[seed % SCENARIO.n_elements] = 0.9
        return dataclasses.replace(surface, stuck=stuck)
    return make


@pytest.fixture(scope='session')
def send():
    """Function that draws pilots of a surface at random positions."""
    def make(scenario, beams, surface, n=N_PILOTS, seed=1):
        rng = np.random.default_rng(seed)
        positions = scenario.sample_positions(n, rng)
        model = MeasurementModel(scenario, beams, surface)
        return Pilots(beams, positions, model.sample(positions, rng))
    return make


@pytest.fixture(scope='session')
def truth():
    """Function that returns gains and offsets of a surface, complex128 [2, N_E]."""
    def of(surface):
        works = np.isnan(surface.stuck)
        return np.where(works, [surface.gains, 0 * surface.gains], [
            0 * surface.gains, surface.gains * np.nan_to_num(surface.stuck)])
    return of
