"""The entry points of the executables, and signals while they are imported."""

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
        cwd=ROOT, capture_output=True, text=True, check=True, timeout=240).stdout
    return re.findall(r'(\w+) = ', printed)


def test_the_table_lists_the_installed_executables():
    assert sorted(executables.EXECUTABLES) == sorted(installed())


@pytest.mark.parametrize(('name', 'folder'), executables.EXECUTABLES.items())
def test_each_executable_has_a_module_with_a_main_function(name, folder):
    source = (ROOT / 'rhs_isac_ros' / folder / f'{name}.py').read_text(encoding='utf-8')
    assert re.search(r'^(def )?main\b', source, re.MULTILINE)


@pytest.mark.parametrize(('name', 'folder'), executables.EXECUTABLES.items())
def test_an_entry_point_runs_its_module_and_returns_the_exit_code(
        name, folder, monkeypatch):
    imported = []

    def import_module(module):
        imported.append(module)
        return types.SimpleNamespace(main=lambda: 7)
    monkeypatch.setattr(importlib, 'import_module', import_module)
    assert getattr(executables, name)() == 7
    assert imported == [f'rhs_isac_ros.{folder}.{name}']
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL


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
        module, present, expected, monkeypatch, capsys):
    without(module, monkeypatch)
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: present or None)
    with pytest.raises(SystemExit, match='1'):
        executables.bs()
    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line


@pytest.mark.parametrize('middleware', ['', 'rmw_fastrtps_cpp'])
def test_a_tool_without_ros_names_what_is_missing(middleware):
    code = """
import runpy, sys
sys.modules.update(dict.fromkeys(['ament_index_python', 'rclpy']))
sys.argv = ['', 'demo']
runpy.run_module('rhs_isac_ros.tools', run_name='__main__')
"""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False, cwd=ROOT,
        env={**os.environ, 'RMW_IMPLEMENTATION': middleware})
    assert (done.returncode, done.stderr) == (
        1, 'demo: error: needs ROS 2 Jazzy, which is not sourced or not installed (no module '
        'rclpy)\n')


def test_a_missing_module_of_the_package_itself_is_not_hidden(monkeypatch):
    without('rhs_isac_ros.nodes.bs', monkeypatch)
    with pytest.raises(ModuleNotFoundError):
        executables.bs()


@pytest.mark.parametrize('name', ['nonsense', '_private', 'topic', 'BS', 'bs_', '__path__'])
def test_any_other_name_is_an_attribute_error(name):
    with pytest.raises(AttributeError, match=f'no attribute {name!r}'):
        getattr(executables, name)


@pytest.mark.parametrize(('call', 'module'), [
    ('executables.bs()', 'nodes.bs'),
    ("sys.argv = ['', 'watch']; runpy.run_module('rhs_isac_ros.tools', run_name='__main__')",
     'tools.watch')])
def test_a_signal_during_the_imports_ends_the_process_without_a_traceback(call, module):
    code = f"""
import importlib, runpy, signal, sys
from rhs_isac_ros import executables
def slow(name):
    print('importing', name, flush=True)
    signal.pause()
importlib.import_module = slow
{call}
"""
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, [ROOT, *sys.path]))})
    assert process.stdout.readline() == f'importing rhs_isac_ros.{module}\n'
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=240)
    assert (process.returncode, errors) == (0, '')
