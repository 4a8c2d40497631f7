"""The emulated board without pauses, and its driver."""

import pytest
from faulty_board import FaultyBoard

from rhs_isac_ros.frontend import OpenSourceRis

# No answer of the emulated board takes as long, even on a busy machine.
TIMEOUT_S = 0.5


@pytest.fixture
def board():
    with FaultyBoard() as board:
        yield board


@pytest.fixture
def driver(board):
    driver = OpenSourceRis(port=board.port, timeout_s=TIMEOUT_S)
    yield driver
    driver.close()
