"""Executables end well on Ctrl-C even while Python still imports."""

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rhs_isac_ros import executables

ROOT = Path(__file__).parents[1]


def names():
    """The executables that the set-up installs."""
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    values = {node.targets[0].id: node.value for node in tree.body if isinstance(node, ast.Assign)}
    return [*ast.literal_eval(values['NODES']), *ast.literal_eval(values['TOOLS'])]


@pytest.mark.parametrize('name', names())
def test_every_executable_has_a_main(name):
    main = getattr(executables, name)
    assert callable(main)
    folder = ROOT / 'rhs_isac_ros'
    assert (folder / 'nodes' / f'{name}.py').exists() != (folder / 'tools' / f'{name}.py').exists()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_imports_ends_without_a_trace(number):
    code = """
import importlib, signal, sys
from rhs_isac_ros import executables
def slow(name):
    print('importing', name, flush=True)
    signal.pause()
importlib.import_module = slow
executables.bs()
"""
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, [ROOT, *sys.path]))})
    assert process.stdout.readline() == 'importing rhs_isac_ros.nodes.bs\n'
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, '')


def test_nothing_else_is_an_executable():
    with pytest.raises(AttributeError):
        executables._private  # noqa: B018
