"""Every public name of every layer has a docstring in NumPy style."""

import ast
import re
from pathlib import Path

import pytest

import rhs_isac_ros

ROOT = Path(rhs_isac_ros.__file__).parent
LAYERS = ('model', 'bounds', 'codebook', 'positioning', 'link', 'experiments', 'protocol',
          'monitoring', 'ros', 'nodes', 'tools')
PROPERTIES = ('property', 'cached_property', 'setter')


def is_public(name: str) -> bool:
    return not name.startswith('_') or name == '__call__'


def modules() -> dict[str, ast.Module]:
    paths = sorted(path for layer in LAYERS for path in (ROOT / layer).rglob('*.py'))
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text(encoding='utf-8'))
            for path in paths}


def decorators(node: ast.FunctionDef) -> set[str]:
    nodes = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    return {d.attr if isinstance(d, ast.Attribute) else d.id for d in nodes}


def public_functions() -> dict[str, tuple[ast.FunctionDef, bool]]:
    """Functions and methods by location, and whether their first argument is self or cls."""
    found = {}
    for path, module in modules().items():
        scopes = [(path, module)]
        scopes += [(f'{path}:{node.name}', node) for node in module.body
                   if isinstance(node, ast.ClassDef) and is_public(node.name)]
        for place, scope in scopes:
            for node in scope.body:
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    if is_public(node.name) and not decorators(node) & set(PROPERTIES):
                        bound = scope is not module and 'staticmethod' not in decorators(node)
                        found[f'{place}:{node.name}'] = (node, bound)
    return found


MODULES, FUNCTIONS = modules(), public_functions()


def section(docstring: str, title: str) -> str:
    """Text of a section; empty if the section is missing."""
    parts = re.split(r'^(\w+)\n-+$', docstring, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True)).get(title, '')


def argument_names(node: ast.FunctionDef, bound: bool) -> list[str]:
    args = node.args
    names = [a.arg for a in (*args.posonlyargs, *args.args)][1 if bound else 0:]
    names += [a.arg for a in args.kwonlyargs]
    names += [a.arg for a in (args.vararg, args.kwarg) if a]
    return names


@pytest.mark.parametrize('path', MODULES)
def test_modules_and_classes_have_docstrings(path):
    module = MODULES[path]
    assert ast.get_docstring(module)
    bare = [node.name for node in module.body if isinstance(node, ast.ClassDef)
            and not ast.get_docstring(node)]
    assert not bare


@pytest.mark.parametrize('place', FUNCTIONS)
def test_docstrings_have_a_summary_and_describe_existing_parameters_in_order(place):
    node, bound = FUNCTIONS[place]
    docstring = ast.get_docstring(node) or ''
    assert docstring.partition('\n')[0].endswith('.'), 'no summary line'
    lines = re.findall(r'^(\S.*)$', section(docstring, 'Parameters'), flags=re.MULTILINE)
    described = [name.strip().lstrip('*\\')
                 for line in lines for name in line.partition(' : ')[0].split(',')]
    arguments = argument_names(node, bound)
    assert described == [name for name in arguments if name in described]


def test_methods_and_properties_have_docstrings():
    bare = [f'{path}:{node.name}.{item.name}' for path, module in MODULES.items()
            for node in module.body if isinstance(node, ast.ClassDef) and is_public(node.name)
            for item in node.body if isinstance(item, ast.FunctionDef)
            and is_public(item.name) and not ast.get_docstring(item)]
    assert not bare
