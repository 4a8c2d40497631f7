"""What `lint-imports` and ruff cannot check: pure layers without ROS, short modules, and names."""

import ast
import collections
import os
import subprocess
import sys
from pathlib import Path

import rhs_isac_ros

ROOT = Path(rhs_isac_ros.__file__).parent
MODULES = {'.'.join(('rhs_isac_ros', *path.relative_to(ROOT).with_suffix('').parts)): path
           for path in sorted(ROOT.rglob('*.py'))}
# All libraries but NumPy, SciPy, PyYAML and threadpoolctl, which alone are always needed.
REFUSED = (
    'rclpy', 'launch', 'launch_ros', 'tf2_ros', 'rosidl_runtime_py', 'dask', 'distributed',
    'joblib', 'lz4', 'matplotlib', 'mcap', 'pymoo', 'rerun', 'rich', 'rosbags', 'sklearn', 'tqdm')
CODE = '''
import importlib, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        root = name.partition('.')[0]
        if root in {refused!r} or root.endswith(('_msgs', '_interfaces')):
            raise ImportError('refused: ' + name)

sys.meta_path.insert(0, Refuse())
for name in {names!r}:
    importlib.import_module(name)
'''


def imported_in_a_fresh_interpreter(names):
    path = os.pathsep.join([str(ROOT.parent), os.environ.get('PYTHONPATH', '')])
    return subprocess.run(
        [sys.executable, '-c', CODE.format(refused=REFUSED, names=names)], text=True, timeout=240,
        capture_output=True, env=os.environ | {'PYTHONPATH': path}, check=False)


def test_pure_layers_can_be_imported_without_ros_and_optional_libraries():
    names = [name.removesuffix('.__init__') for name in MODULES
             if name.split('.')[1] not in ('ros', 'nodes', 'tools')]
    done = imported_in_a_fresh_interpreter(names)
    assert done.returncode == 0, done.stderr
    assert 'refused: rclpy' in imported_in_a_fresh_interpreter(['rclpy']).stderr


def test_modules_can_be_read_from_top_to_bottom():
    assert not [name for name, path in MODULES.items()
                if len(path.read_text(encoding='utf-8').splitlines()) > 600]


def test_no_two_public_classes_have_the_same_name():
    """Readers of a name know which class it is, wherever it stands."""
    found = collections.defaultdict(list)
    for name, path in MODULES.items():
        for node in ast.parse(path.read_text(encoding='utf-8')).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
                found[node.name].append(name)
    assert {name: modules for name, modules in found.items()
            if len(modules) > 1} == {}
