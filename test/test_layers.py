"""The layers of the package and the imports that they permit."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import rhs_isac_ros

LAYERS = (
    'support', 'model', 'calibration', 'bounds', 'codebook', 'positioning', 'link', 'experiments',
    'protocol', 'monitoring', 'ros', 'nodes', 'tools')
ROS_LAYERS = ('ros', 'nodes', 'tools')
PURE_LAYERS = tuple(layer for layer in LAYERS if layer not in ROS_LAYERS)
# The libraries that the pure layers may import at module level.
LIBRARIES = {'numpy', 'scipy', 'threadpoolctl', 'yaml'}
# The libraries that they may import inside functions, which raise an error if one is missing. Only
# pictures, the genetic algorithm, the training of networks and experiments need these.
OPTIONAL = {'distributed', 'joblib', 'matplotlib', 'pymoo', 'sklearn', 'tqdm'}
ROOT = Path(rhs_isac_ros.__file__).parent
MODULES = sorted(ROOT.rglob('*.py'))
# A module may have this many lines if it is one idea.
MAX_LINES = 600


def module_name(path: Path) -> str:
    return '.'.join(('rhs_isac_ros', *path.relative_to(ROOT).with_suffix('').parts))


def outside_functions(tree: ast.AST):
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            yield from outside_functions(node)


def imported(path: Path, walk=ast.walk) -> set[str]:
    """Full names of the imports of a module among the nodes that `walk` visits."""
    names = set()
    for node in walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            # An import from the package itself may be a layer.
            names.add(node.module)
            names.update(f'{node.module}.{alias.name}' for alias in node.names)
    return names


def roots(names: set[str]) -> set[str]:
    return {name.partition('.')[0] for name in names}


def layer_of(name: str) -> str | None:
    parts = name.split('.')
    if parts[0] != 'rhs_isac_ros' or len(parts) == 1:
        return None
    return parts[1] if parts[1] in LAYERS else None


def test_the_package_consists_of_its_layers():
    folders = {path.name for path in ROOT.iterdir()
               if path.is_dir() and any(path.rglob('*.py'))}
    assert folders <= set(LAYERS)
    assert set(PURE_LAYERS[:4]) <= folders
    assert {path.name for path in ROOT.glob('*.py')} == {'__init__.py', 'executables.py'}


@pytest.mark.parametrize('path', MODULES, ids=module_name)
def test_modules_import_no_higher_layer(path):
    own = layer_of(module_name(path))
    allowed = () if own is None else LAYERS[:LAYERS.index(own) + 1]
    above = {name for name in imported(path) if (layer_of(name) or own) != own
             and layer_of(name) not in allowed}
    assert not above


@pytest.mark.parametrize(
    'path', [path for path in MODULES if layer_of(module_name(path)) not in ROS_LAYERS],
    ids=module_name)
def test_pure_layers_import_no_ros(path):
    """Outside functions, they import only the standard library and four other libraries."""
    always = set(sys.stdlib_module_names) | LIBRARIES | {'rhs_isac_ros'}
    assert roots(imported(path, outside_functions)) <= always
    assert roots(imported(path)) <= always | OPTIONAL


def test_pure_layers_can_be_imported_without_ros():
    """In a fresh interpreter that refuses ROS and the optional libraries."""
    names = [module_name(path).removesuffix('.__init__') for path in MODULES
             if layer_of(module_name(path)) in PURE_LAYERS]
    refused = ('rclpy', 'launch', 'launch_ros', 'tf2_ros', *sorted(OPTIONAL))
    code = f'''
import importlib, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        root = name.partition('.')[0]
        if root in {refused!r} or root.endswith(
                ('_msgs', '_interfaces')) or root.startswith(('rosidl', 'rpyutils')):
            raise ImportError('refused: ' + name)

sys.meta_path.insert(0, Refuse())
for name in {names!r}:
    importlib.import_module(name)
try:
    importlib.import_module('rclpy')
except ImportError:
    print('done')
'''
    paths = [str(ROOT.parent), *filter(None, [os.environ.get('PYTHONPATH')])]
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=60,
        env=os.environ | {'PYTHONPATH': os.pathsep.join(paths)}, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == 'done'


@pytest.mark.parametrize('path', MODULES, ids=module_name)
def test_modules_can_be_read_from_top_to_bottom(path):
    assert len(path.read_text(encoding='utf-8').splitlines()) <= MAX_LINES
