"""The driver of the board: applied or a fault, and service again after each fault."""

import contextlib
import time

import numpy as np
import pytest
from faulty_board import ANSWER_S, NO_ANSWER_S, impatient

from rhs_isac_ros.frontend import OpenSourceRis, SurfaceFault
from rhs_isac_ros.frontend.opensourceris import to_configuration, to_digits
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions


def patterns(n, seed=0):
    return np.random.default_rng(seed).integers(0, 2, (n, 256))


def fault_of(call, *arguments):
    with pytest.raises(SurfaceFault) as caught:
        call(*arguments)
    return caught.value


@pytest.mark.parametrize(('element', 'digits'), [
    (0, '0' * 60 + '8000'), (15, '0' * 60 + '0001'), (240, '8' + '0' * 63),
    (255, '0001' + '0' * 60)])
def test_the_first_bit_is_the_top_left_element(element, digits):
    configuration = np.arange(256) == element
    assert to_digits(configuration) == digits.encode()
    assert (to_configuration(digits.encode()) == configuration).all()
    # Seen from the front, y points to the right.
    top_left = element_positions(Scenario(elements_per_side=16))[240]
    assert top_left[1] < 0 < top_left[2]


@pytest.mark.parametrize('at', [0, 5])
@pytest.mark.parametrize(('fault', 'kind', 'text'), [
    ('silence', 'silence', "no answer to b'!0x......' within"),
    ('flipped bit', 'mismatch', '1 of 256 elements differ from the pattern that was set, first '
     'element 15'),
    ('restart', 'restart', 'the board has restarted and lost its pattern'),
    ('late', 'silence', "no answer to b'!0x......' within"),
    ('closed', 'closed', 'the port cannot be used: '),
    ('occupied', 'closed', 'the port cannot be used: ')])
def test_a_fault_at_a_pattern_is_one_error_and_the_next_pattern_is_right(
        board, driver, fault, kind, text, at):
    board.faults = {at: fault}
    for index, pattern in enumerate(patterns(8)):
        if index != at:
            driver.apply(pattern)
            assert (board.configuration == pattern).all()
            continue
        with impatient(driver) if kind == 'silence' else contextlib.nullcontext():
            caught = fault_of(driver.apply, pattern)
        assert caught.kind == kind
        with pytest.raises(SurfaceFault, match=f'^{board.port}: {text}'):
            raise caught
        # These last until the board is plugged in again.
        if fault in ('closed', 'occupied'):
            assert fault_of(driver.apply, pattern).kind == fault
            board.plug()


def test_without_read_back_a_flipped_bit_remains_unnoticed(board, driver):
    blind = OpenSourceRis(port=board.port, timeout_s=ANSWER_S, read_back=False)
    board.faults = {0: 'flipped bit'}
    blind.apply(np.zeros(256))
    assert board.configuration.sum() == 1
    blind.close()


def test_a_late_answer_never_confirms_a_later_pattern(board):
    driver = OpenSourceRis(port=board.port, timeout_s=ANSWER_S, read_back=False)
    first, second = patterns(2)
    board.faults = {0: 'late', 1: 'silence'}
    with impatient(driver):
        assert fault_of(driver.apply, first).kind == 'silence'
    # The answer to the first pattern arrives, and the board loses the second one.
    with impatient(driver):
        assert fault_of(driver.apply, second).kind == 'silence'
    assert (board.configuration == first).all()
    driver.close()


def test_an_answer_that_no_command_asked_for_is_a_fault(board, driver):
    pattern, other = patterns(2)
    driver.apply(pattern)
    board.send(b'#OK\n')
    assert fault_of(driver.apply, other).kind in ('stray', 'garbled')
    driver.apply(other)
    assert (board.configuration == other).all()


def test_a_restart_between_two_patterns_is_reported(board, driver):
    driver.apply(np.ones(256))
    board.send(b'\nOpen Source RIS\nFirmware version: 1.1\n#READY!\n')
    assert fault_of(driver.apply, np.ones(256)).kind == 'restart'
    driver.apply(np.ones(256))


def test_a_port_has_one_driver(board, driver):
    other = OpenSourceRis(port=board.port)
    driver.apply(np.zeros(256))
    fault = fault_of(other.apply, np.ones(256))
    assert (fault.kind, str(fault)) == (
        'occupied', f'{board.port}: another process uses the port')
    # The refused driver leaves the port as it is.
    driver.apply(np.ones(256))
    driver.close()
    other.apply(np.zeros(256))
    other.close()


@pytest.mark.parametrize('port', ['/dev/null', 'nothing', ''])
def test_what_is_no_serial_port_cannot_be_used(port):
    driver = OpenSourceRis(port=port)
    assert fault_of(driver.apply, np.zeros(256)).kind == 'closed'
    driver.close()


def malformed(rng):
    """Return a line of random characters, or one that resembles an answer."""
    if rng.random() < 0.5:
        return rng.bytes(rng.integers(1, 90)).replace(b'\n', b'') + b'\n'
    return rng.choice(np.array([
        b'#OK', b'#ok\n', b'#OK \n', b'#0X\n', b'#0X' + b'0' * 63 + b'\n',
        b'\r\n', b'#SerNo:\n', b'#READY!\n', b'#0X' + b'G' * 64 + b'\n'], object))


def test_malformed_lines_confirm_nothing_and_do_not_end_the_service(board, driver):
    rng = np.random.default_rng(0)
    for pattern in patterns(20):
        driver.apply(pattern)
        board.send(b''.join(malformed(rng) for _ in range(100)))
        assert fault_of(driver.apply, 1 - pattern).kind in ('stray', 'garbled', 'restart')
        driver.apply(1 - pattern)
        assert (board.configuration == 1 - pattern).all()


def test_characters_without_a_line_break_are_no_answer_and_do_not_fill_the_memory(board, driver):
    driver.apply(np.zeros(256))
    board.send(b'x' * 2999 + b'y')
    # On a busy machine, they arrive in parts.
    while not driver._port._received.endswith(b'y'):
        assert driver._port.line(time.monotonic() + NO_ANSWER_S) is None
    assert len(driver._port._received) == 256
    fault_of(driver.apply, np.ones(256))
    driver.apply(np.ones(256))
    assert board.configuration.all()
