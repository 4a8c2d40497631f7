"""The emulated board without pauses, and its driver."""

import pytest

from rhs_isac_ros.frontend import OpenSourceRis
from rhs_isac_ros.frontend.opensourceris_emulator import EmulatedBoard

# No answer of the emulated board takes as long, even on a busy machine.
TIMEOUT_S = 0.5


@pytest.fixture
def board():
    with EmulatedBoard(is_paced=False) as board:
        yield board


@pytest.fixture
def driver(board):
    driver = OpenSourceRis(port=board.port, timeout_s=TIMEOUT_S)
    yield driver
    driver.close()
