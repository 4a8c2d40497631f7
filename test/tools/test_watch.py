"""``scripts/watch`` on a network in another process."""

import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rclpy.node import Node

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.tools.command import expecting_cycles
from rhs_isac_ros.tools.watch import main

pytest.importorskip('rich', reason='rich is not installed')
ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / 'scripts' / 'watch'


def test_once_prints_a_cycle_and_every_node(network, run_script):
    # Wide enough for the faults of a loaded machine in one line.
    text = run_script(f'env COLUMNS=200 {SCRIPT} --once')
    codebook = Codebook.load(ROOT / 'config' / 'codebook_quick.yaml')
    assert f'codebook {codebook.id}' in text
    row = (r'^ +[12] +(-?\d+\.\d\d +){3}\d+\.\d\d +\d+\.\d\d +(\d+/\d+ +)?\d+\.\d\d +\d+\.\d{3} '
           r'+\d+\.\d *$')
    assert re.search(row, text, re.MULTILINE), text
    for node in ('bs', 'channel', 'optimizer', 'positioner', 'rhs_controller', 'transmission',
                 'user_1', 'user_2'):
        assert re.search(f'^ {node} .*(no fault +|new faults: )', text, re.MULTILINE), text


def test_watch_refreshes_the_terminal_until_it_is_interrupted(built_scripts, network):
    parent, child = pty.openpty()
    with subprocess.Popen([SCRIPT], stdin=child, stdout=child, stderr=child) as process:
        os.close(child)
        text = b''
        # Two views of a running network.
        while text.count(b'cycles/s') < 2:
            text += os.read(parent, 65536)
        process.send_signal(signal.SIGINT)
        try:
            while True:
                text += os.read(parent, 65536)
        except OSError:  # closed when the process ends
            os.close(parent)
        assert process.wait(30) == 0
    assert b'Traceback' not in text
    # The terminal is restored.
    assert text.rstrip().endswith(b'\x1b[?1049l')


@pytest.mark.parametrize(('arguments', 'missing'), [
    (['watch', '--once'], 'no complete cycle'), (['snapshot'], 'no user found'),
    (['calibrate'], '0 of 200 pilots')])
def test_a_command_without_a_network_is_an_error(built_scripts, tmp_path, arguments, missing):
    done = subprocess.run(
        [SCRIPT.with_name(arguments[0]), *arguments[1:], '--timeout', '0.3', '--ros-args', '-r',
         '__ns:=/nobody'], capture_output=True, text=True, cwd=tmp_path, timeout=240, check=False)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr.startswith(
        f'{arguments[0]}: error: {missing} within 0.3 s, in the domain ')
    assert not list(tmp_path.iterdir())


def test_a_namespace_without_a_base_station_is_named_if_another_one_has_one(bench, capfd):
    """A surface of a site that follows, and the site itself, have none."""
    spaces = ('/site/front', '/site/side', '/site')
    for name, space in zip(('bs', 'receiver', 'fusion'), spaces, strict=True):
        bench.add(Node, name, namespace=space)
    for space in spaces:
        expecting_cycles(bench.add(Node, 'watch', namespace=space), 0.1)
    log = []
    bench.until(lambda: log.append(capfd.readouterr().err) or all(
        f'no base station in the namespace {space};' in ''.join(log) for space in spaces[1:]),
        'the warnings')
    warnings = [line for line in ''.join(log).splitlines() if 'WARN' in line]
    assert len(warnings) == 2 and all(line.endswith('/site/front') for line in warnings)


def test_a_missing_library_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'rich', None)
    assert main(['--once']) == 1
    assert capsys.readouterr().err == (
        'watch: error: watch needs rich, which is not installed '
        "(pip install 'rhs_isac_ros[watch]')\n")
