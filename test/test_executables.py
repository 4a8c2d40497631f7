"""The entry points of the executables, and signals while they are imported."""

import ast
import importlib
import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest

from rhs_isac_ros import executables

ROOT = Path(__file__).parents[1]


def installed():
    """Names of the executables that setup.py installs."""
    printed = subprocess.run(
        [sys.executable, '-c', 'import runpy, setuptools\n'
         'setuptools.setup = lambda **options: print(*options["entry_points"].popitem()[1])\n'
         'runpy.run_path("setup.py")'],
        cwd=ROOT, capture_output=True, text=True, check=True, timeout=60).stdout
    return re.findall(r'(\w+) = ', printed)


def test_the_table_lists_the_installed_executables():
    assert sorted(executables.EXECUTABLES) == sorted(installed())


@pytest.mark.parametrize(('name', 'folder'), executables.EXECUTABLES.items())
def test_each_executable_has_a_module_with_a_main_function(name, folder):
    source = (ROOT / 'rhs_isac_ros' / folder / f'{name}.py').read_text(encoding='utf-8')
    defined = {part.id for node in ast.parse(source).body if isinstance(node, ast.Assign)
               for part in ast.walk(node) if isinstance(part, ast.Name)} | {
        node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)}
    assert 'main' in defined


@pytest.fixture
def signal_handlers():
    """Restore the signal handlers after the test."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(('name', 'folder'), executables.EXECUTABLES.items())
def test_an_entry_point_runs_its_module_and_returns_the_exit_code(
        name, folder, monkeypatch, signal_handlers):
    imported = []

    def import_module(module):
        imported.append(module)
        return types.SimpleNamespace(main=lambda: 7)
    monkeypatch.setattr(importlib, 'import_module', import_module)
    # With ROS arguments alone, a node joins the network first.
    monkeypatch.setattr(sys, 'argv', [name, '--help'])
    assert getattr(executables, name)() == 7
    assert imported == [f'rhs_isac_ros.{folder}.{name}']
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def without(module, monkeypatch):
    def import_module(_):
        raise ModuleNotFoundError(f'No module named {module!r}', name=module)
    monkeypatch.setattr(importlib, 'import_module', import_module)


@pytest.mark.parametrize(('module', 'present', 'expected'), [
    ('rclpy', False, 'bs: error: needs ROS 2 Jazzy, '),
    ('rhs_isac_msgs', False, 'bs: error: needs ROS 2 Jazzy, '),
    ('rhs_isac_msgs.msg', True, 'run `ln -s rhs_isac_ros/msg_defs rhs_isac_msgs`'),
    ('scipy.linalg', True, 'bs: error: needs scipy, which is not installed')])
def test_a_missing_package_is_named_in_one_line(
        module, present, expected, monkeypatch, signal_handlers, capsys):
    without(module, monkeypatch)
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: present or None)
    assert executables.bs() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line


@pytest.mark.parametrize(('spec', 'expected'), [
    (None, 'fig4.py: error: x\n'),
    (types.SimpleNamespace(name='lab.__main__'), 'python3 -m lab: error: x\n'),
    (types.SimpleNamespace(name='lab.tool'), 'python3 -m lab.tool: error: x\n')])
def test_an_error_names_the_program_of_the_process_by_default(spec, expected, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, '__main__', types.SimpleNamespace(__spec__=spec))
    monkeypatch.setattr(sys, 'argv', ['/lab/fig4.py', 'x'])
    executables.print_error('x')
    assert capsys.readouterr().err == expected


def test_an_error_of_the_user_names_the_program(capsys):
    def fail():
        raise LookupError('no such place')
    assert executables.exit_code_of(fail, (LookupError,), 'lab') == 2
    assert capsys.readouterr().err == 'lab: error: no such place\n'


def test_a_missing_module_of_the_package_itself_is_not_hidden(monkeypatch, signal_handlers):
    without('rhs_isac_ros.nodes.bs', monkeypatch)
    with pytest.raises(ModuleNotFoundError):
        executables.bs()


@pytest.mark.parametrize('name', ['nonsense', '_private', 'topic', 'BS', 'bs_', '__path__'])
def test_any_other_name_is_an_attribute_error(name):
    with pytest.raises(AttributeError, match=f'no attribute {name!r}'):
        getattr(executables, name)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_imports_ends_the_process_without_a_traceback(number):
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
    assert process.stdout.readline() == 'importing rhs_isac_ros.nodes\n'
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, '')
