"""package.xml lists every imported package, and all files state one version."""

import ast
import functools
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from test_installation import read_extras

import rhs_isac_ros

ROOT = Path(__file__).parents[1]
FOLDERS = ('rhs_isac_ros', 'launch', 'scripts', 'test', 'docs')
# Keys in rosdistro's rosdep/python.yaml by the name of the import, if it is not python3-<name>; a
# ROS package is its own key. threadpoolctl has no key: the system's scikit-learn depends on it.
KEYS = {'docutils': 'python3-sphinx', 'threadpoolctl': 'python3-sklearn'} | {
    name: f'python3-{name}' for name in (
        'hypothesis', 'joblib', 'matplotlib', 'numpy', 'packaging', 'psutil', 'pytest', 'rich',
        'scipy', 'sklearn', 'sphinx', 'tqdm', 'yaml')}
# Libraries without a key, by the name of the import: their requirement in an extra of setup.py.
# mcap requires lz4 and zstandard.
PIP_ONLY = {
    'adi': None, 'distributed': 'distributed', 'h5py': 'h5py', 'jax': None, 'lz4': 'mcap>=1.6',
    'mcap': 'mcap>=1.6', 'mcap_ros2': 'mcap-ros2-support', 'pymoo': 'pymoo',
    'rerun': 'rerun-sdk>=0.22.1,<0.42',
    'rosbags': 'rosbags', 'sigmf': 'sigmf', 'sionna': None, 'skrf': 'scikit-rf',
    'zstandard': 'mcap>=1.6',
}


@functools.cache
def imported(folder):
    """Libraries that the modules of a folder import, each with one importing module."""
    own = {path.stem if path.suffix else path.name for name in FOLDERS
           for path in (ROOT / name, *(ROOT / name).rglob('*'))}
    found = {}
    for path in sorted((ROOT / folder).rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module]
            found |= {name.partition('.')[0]: path for name in names}
    # The package `launch` of ROS has the name of a folder.
    return {name: path for name, path in found.items()
            if name not in sys.stdlib_module_names and (name not in own or name == 'launch')}


def keys(*kinds):
    tree = ElementTree.parse(ROOT / 'package.xml').getroot()
    return {node.text for kind in ('depend', 'exec_depend', *kinds) for node in tree.iter(kind)}


@pytest.mark.parametrize(('folder', 'kinds'), [
    ('rhs_isac_ros', ()), ('launch', ()), ('scripts', ()), ('test', ('test_depend',)),
    ('docs', ('doc_depend',))])
def test_every_import_has_a_key_or_is_an_extra(folder, kinds):
    extras = {None}.union(*read_extras().values())
    assert not {name: path for name, path in imported(folder).items()
                if (PIP_ONLY[name] not in extras if name in PIP_ONLY
                    else KEYS.get(name, name) not in keys(*kinds))}


def test_every_key_is_used():
    used = {KEYS.get(name, name) for folder in FOLDERS for name in imported(folder)}
    # launch reads .xml files with a plug-in.
    assert keys('test_depend', 'doc_depend') <= used | {'launch_xml'}


@pytest.mark.parametrize(('path', 'pattern'), [
    ('package.xml', '<version>(.*)</version>'),
    ('msg_defs/package.xml', '<version>(.*)</version>'), ('setup.py', "version='(.*)'"),
    ('CITATION.cff', '^version: (.*)$'),
    ('CHANGELOG.rst', r'^(\d[^ ]*) \(.*\)$'), ('msg_defs/CHANGELOG.rst', r'^(\d[^ ]*) \(.*\)$')])
def test_all_files_state_one_version(path, pattern):
    text = (ROOT / path).read_text(encoding='utf-8')
    assert re.findall(pattern, text, re.MULTILINE)[0] == rhs_isac_ros.__version__


@pytest.mark.parametrize(('variables', 'is_reported'), [
    ({'COLCON': '1', 'AMENT_PREFIX_PATH': ''}, True),
    ({'COLCON': '1', 'AMENT_PREFIX_PATH': '{}'}, False), ({}, False)])
def test_a_build_without_the_messages_prints_the_missing_link(variables, is_reported, tmp_path):
    (tmp_path / 'share' / 'rhs_isac_msgs').mkdir(parents=True)
    environment = {name: value for name, value in os.environ.items() if name != 'COLCON'} | {
        name: value.format(tmp_path) for name, value in variables.items()}
    done = subprocess.run([sys.executable, 'setup.py', '--version'], cwd=ROOT, env=environment,
                          capture_output=True, text=True, check=True)
    assert ('ln -s rhs_isac_ros/msg_defs rhs_isac_msgs' in done.stderr) == is_reported
