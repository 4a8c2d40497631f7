"""Messages of one cycle of one user, for tests of single roles."""

import numpy as np
import pytest

from rhs_isac_ros.link import steer
from rhs_isac_ros.protocol import messages as m

PLACE = np.array([8.0, -2.0, 0.5])


@pytest.fixture
def truth():
    return m.GroundTruth(cycle_id=3, user=1, position=PLACE, velocity=np.zeros(3))


@pytest.fixture
def beam(scenario):
    found = steer(scenario, PLACE)
    return m.Beam(
        cycle_id=3, user=1, codebook_id='x', band=0, analog=found.analog, digital=found.digital,
        expected_bps=5e6)


@pytest.fixture
def applied(beam):
    """The report of the surface after it has applied the beam."""
    return m.RhsConfiguration(
        cycle_id=3, mode=m.Mode.TRANSMISSION, band=0, codebook_id='x', analog=beam.analog[None])
