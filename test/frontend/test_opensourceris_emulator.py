"""The emulated board answers as the genuine firmware does, at the speed of its port."""

import ast
import os
import threading
import time
from pathlib import Path

from rhs_isac_ros.frontend.opensourceris import OpenSourceRis
from rhs_isac_ros.frontend.opensourceris_emulator import BANNER, EmulatedBoard, Firmware

TRANSCRIPT = (Path(__file__).parents[1] / 'data' / 'opensourceris.txt').read_text('utf-8')
A5, F, ZEROS = b'a5' * 32, b'F' * 64, b'0' * 63
INPUTS = [
    b'!0x8' + ZEROS + b'\n', b'?Pattern\n', b'?pattern\n', b'!0x8' + ZEROS + b'\r\n',
    b'?Pattern\n', b'!0x' + F[1:] + b'\n', b'!0x' + F + b'F\n', b'!0x' + b'G' * 64 + b'\n',
    b'!0x' + F[:30] + b'\n', b'?Foo\n', b'?Vext\n', b'?SerialNo\n',
    b'\x00\xff!0x8' + ZEROS + b'\n', b'!0xFFFF!0x' + A5 + b'\n', b'?Pattern\n',
    b'!0x' + A5 + b'\n', b'?Pattern\n', b'\n', b'hello\n', b'!BT-Key=12345\n', b'?Pat tern\n',
    b'!' + b'0' * 200 + b'\n', b'?Pattern\n', b'!!!0x' + A5 + b'\n', b'?!0x' + A5 + b'\n',
    b'!0x' + A5 + b'\n', b'?Pattern\n']


def answer_of(firmware, text):
    return b''.join(firmware.receive(bytes([value])) for value in text)


def test_the_answers_are_those_of_the_transcript():
    """Each line but the last has the first 16 characters of the input, its length, the answer."""
    *lines, banner = TRANSCRIPT.splitlines()
    firmware = Firmware()
    written = [(text[:16], len(text), answer_of(firmware, text)) for text in INPUTS]
    exchanges = []
    for line in lines:
        command, answer = line.split(' -> ')
        start, length = command.rsplit(' ', 1)
        exchanges.append((ast.literal_eval(start), int(length), ast.literal_eval(answer)))
    assert written == exchanges
    assert answer_of(firmware, b'!Reset\n') == ast.literal_eval(banner) == BANNER
    assert answer_of(firmware, b'?Pattern\n') == b'#0X' + b'0' * 64 + b'\n'


def test_of_eight_commands_at_once_four_are_answered(board):
    file = os.open(board.port, os.O_RDWR | os.O_NOCTTY)
    os.write(file, INPUTS[0] * 8 + b'\n?Vext\n')
    received = b''
    while not received.endswith(b'V\n'):
        received += os.read(file, 4096)
    os.close(file)
    assert received == b'#OK\n' * 4 + b'#05.80 V\n'
    assert board.n_patterns == 4


def test_a_paced_board_is_as_slow_as_its_port():
    with EmulatedBoard() as board:
        driver = OpenSourceRis(port=board.port, timeout_s=60.0, read_back=False)
        driver.supply_voltage_v()
        start_s = time.monotonic()
        driver.apply([0] * 256)
        set_s = time.monotonic()
        driver.read()
        # 68 and 9 characters, with answers of 4 and 68 characters, of 10 bits each.
        assert set_s - start_s >= 72 * 10 / 115_200
        assert time.monotonic() - set_s >= 77 * 10 / 115_200
        driver.close()


def test_an_unplugged_board_leaves_nothing():
    before = threading.active_count(), sorted(os.listdir('/proc/self/fd'))
    with EmulatedBoard() as board:
        board.plug()
        assert os.path.exists(board.port)
    assert not os.path.lexists(board.port)
    assert not os.path.exists(os.path.dirname(board.port))
    assert (threading.active_count(), sorted(os.listdir('/proc/self/fd'))) == before
