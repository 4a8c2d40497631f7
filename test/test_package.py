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

import rhs_isac_ros

ROOT = Path(__file__).parents[1]
TREE = ElementTree.parse(ROOT / 'package.xml').getroot()
# Keys in rosdistro's rosdep/python.yaml by the name of the import; a ROS package is its own key.
# threadpoolctl has no key: the system's scikit-learn depends on it.
KEYS = {
    'docutils': 'python3-sphinx', 'hypothesis': 'python3-hypothesis', 'joblib': 'python3-joblib',
    'matplotlib': 'python3-matplotlib', 'numpy': 'python3-numpy',
    'packaging': 'python3-packaging', 'psutil': 'python3-psutil',
    'pytest': 'python3-pytest', 'rich': 'python3-rich', 'scipy': 'python3-scipy',
    'sklearn': 'python3-sklearn', 'sphinx': 'python3-sphinx', 'threadpoolctl': 'python3-sklearn',
    'tqdm': 'python3-tqdm', 'yaml': 'python3-yaml',
}
# Libraries without a key, by the name of the import: their requirement in an extra of setup.py.
# mcap requires lz4 and zstandard.
PIP_ONLY = {
    'distributed': 'distributed', 'jax': None, 'lz4': 'mcap', 'mcap': 'mcap',
    'mcap_ros2': 'mcap-ros2-support', 'pymoo': 'pymoo', 'rerun': 'rerun-sdk==0.22.1',
    'rosbags': 'rosbags', 'sionna': None, 'stonesoup': None, 'zstandard': 'mcap',
}
# Modules of the repository.
OWN = {
    'rhs_isac_ros', 'parts', 'peers', 'diagram', 'sequence', 'run_notebook', 'pictures',
    'conftest', 'forked',
    'headless_browser', 'impairment_checks', 'in_memory_network', 'node_processes', 'ros_messages',
    'system', 'test_installation'}


@functools.cache
def imported(folder):
    """Top-level packages that the modules of a folder import, each with one importing module."""
    found = {}
    for path in sorted((ROOT / folder).rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module]
            found |= {name.partition('.')[0]: path for name in names}
    return {name: path for name, path in found.items()
            if name not in sys.stdlib_module_names and name not in OWN}


def keys(*kinds):
    return {node.text for kind in kinds for node in TREE.iter(kind)}


def extras():
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    (found,) = [ast.literal_eval(node.value) for node in ast.walk(tree)
                if isinstance(node, ast.keyword) and node.arg == 'extras_require']
    return {name for names in found.values() for name in names}


RUN = ('depend', 'exec_depend')


@pytest.mark.parametrize(('folder', 'kinds'), [
    ('rhs_isac_ros', RUN), ('launch', RUN), ('scripts', RUN),
    ('test', (*RUN, 'test_depend')), ('docs', (*RUN, 'doc_depend'))])
def test_every_import_has_a_key_or_is_an_extra(folder, kinds):
    there, missing = keys(*kinds), {}
    for name, path in imported(folder).items():
        if name in PIP_ONLY:
            if PIP_ONLY[name] and PIP_ONLY[name] not in extras():
                missing[name] = f'{path}: not in any extra of setup.py'
        elif KEYS.get(name, name) not in there:
            missing[name] = f'{path}: no {KEYS.get(name, name)} in package.xml'
    assert not missing


def test_every_key_is_used():
    folders = ('rhs_isac_ros', 'launch', 'scripts', 'test', 'docs')
    used = {KEYS.get(name, name) for folder in folders
            for name in imported(folder)}
    # launch reads .xml files with a plug-in.
    assert keys(*RUN, 'test_depend', 'doc_depend') <= used | {'launch_xml'}


def test_libraries_have_keys_that_rosdep_knows():
    libraries = {key for key in keys(*RUN, 'test_depend', 'doc_depend')
                 if key.startswith('python3-')}
    assert libraries <= set(KEYS.values())


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
