"""The emulated board without pauses, and its driver."""

import pytest
from faulty_board import ANSWER_S, FaultyBoard

from rhs_isac_ros.frontend import OpenSourceRis


@pytest.fixture
def board():
    with FaultyBoard() as board:
        yield board


@pytest.fixture
def driver(board):
    driver = OpenSourceRis(port=board.port, timeout_s=ANSWER_S)
    yield driver
    driver.close()
