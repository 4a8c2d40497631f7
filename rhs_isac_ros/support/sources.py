"""Descriptions of what a result depends on: sources, and values that functions use."""

import ast
import contextlib
import functools
import hashlib
import inspect
import json
import sys
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros import __version__

# Code contains only constants. Its description takes milliseconds for a module.
_of_code = functools.cache(
    lambda code: _definition((code.co_code, code.co_names, code.co_consts), set()))


def sources_of(*uses: Any) -> str:
    """Return the version of this package with a digest of the sources of a job's result.

    `uses` are its function, and the plug-ins that its arguments name. The sources are the modules
    of this package, those of the uses, those that they import from, and what `_definition`
    returns. Sources in an archive have no digest.
    """
    files, texts = set(), []
    for one in uses:
        texts.append(_definition(one, set()))
        while isinstance(one, functools.partial):
            one = one.func
        # If a module is loaded again, files are read again only if this code differs. They do not
        # contain what an enclosing function binds.
        texts += [_definition(
            (inspect.unwrap(member).__code__, _bound(member))
            if inspect.isfunction(member) else member, set()) for name, member in (
                vars(one).items() if isinstance(one, type) else [('', one)])
            if inspect.isfunction(member) or name[:1] not in ('', '_')]
        module = sys.modules.get(getattr(one, '__module__', ''))
        named = vars(module).values() if module else ()
        modules = [module, *(
            value if inspect.ismodule(value) else
            sys.modules.get(str(getattr(value, '__module__', ''))) for value in named)]
        files |= {str(getattr(one, '__file__', '')) for one in modules if one}
    return f'{__version__} {_digest(*sorted(files), text=json.dumps(texts))}'


def _definition(value: Any, seen: set[int]) -> Any:
    """Describe a function or class, or a value that it uses, apart from what files contain.

    A function has bound arguments and, without a file, as in a notebook, its code and all that it
    uses. A class without a file has its bases and members. `seen` contains the identities of those
    that are already described. The description is for JSON.
    """
    for wrapper, name in ((property, 'fget'), (functools.cached_property, 'func'),
                          (classmethod | staticmethod, '__func__')):
        value = getattr(value, name) if isinstance(value, wrapper) else value
    if isinstance(value, functools.partial):
        value = (value.func, value.args, value.keywords)
    if inspect.ismethod(value):
        value = (value.__func__, value.__self__)
    if isinstance(value, np.ndarray):
        value = (value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest())
    if isinstance(value, Mapping):
        return [[str(name), _definition(one, seen)] for name, one in value.items()]
    if isinstance(value, list | tuple | set | frozenset):
        ordered = value if isinstance(value, list | tuple) else sorted(value, key=repr)
        return [_definition(one, seen) for one in ordered]
    if inspect.iscode(value):
        return _of_code(value)
    is_function, is_class = inspect.isfunction(value), isinstance(value, type)
    kind: Any = type(value)
    if not (is_function or is_class) and (
            hasattr(value, 'id') or kind.__repr__ is not object.__repr__):
        return repr(getattr(value, 'id', value))
    if id(value) in seen:
        return ''
    seen.add(id(value))
    if is_class:
        if value.__module__ in sys.builtin_module_names or hasattr(
                sys.modules.get(value.__module__), '__file__'):
            return value.__qualname__
        # Other names with underscores are those that Python itself adds.
        return _definition((value.__qualname__, value.__bases__, {
            name: member for name, member in vars(value).items()
            if inspect.isfunction(member) or not name.startswith('__')}), seen)
    if not is_function:
        return _definition((kind, getattr(value, '__dict__', {})), seen)
    parts = (value.__qualname__, _bound(value))
    if Path(value.__code__.co_filename).is_file():
        return _definition((*parts, value.__code__.co_firstlineno), seen)
    return _definition((*parts, value.__code__, value.__defaults__, value.__kwdefaults__, {
        name: value.__globals__[name] for name in _names(value.__code__)
        if name in value.__globals__}), seen)


def _bound(function: types.FunctionType) -> dict[str, Any]:
    """Return the values of enclosing functions that a function uses, without those not yet set."""
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):
            found[name] = cell.cell_contents
    return found


def _names(code: types.CodeType) -> list[str]:
    """Return the names in code, and in that of functions and comprehensions in it."""
    return sorted({*code.co_names}.union(*map(_names, filter(inspect.iscode, code.co_consts))))


@functools.cache
def _digest(*files: str, text: str) -> str:
    """Return a digest of this package, further modules and a text, 16 hexadecimal digits."""
    package = Path(__file__).parents[1]
    others = [path for file in files if package not in (path := Path(file)).parents]
    whole = hashlib.sha256(text.encode())
    for path in (*sorted(package.rglob('*.py')), *others):
        if path.suffix == '.py' and path.is_file():
            whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()[:16]


def code_of(module: types.ModuleType) -> str:
    """Return a digest of a module's functions, classes and constants as this process has them."""
    codes = {f'{name}.{part}': inspect.unwrap(one).__code__ for name, value in vars(module).items()
             if getattr(value, '__module__', '') == module.__name__
             for part, one in (vars(value).items() if isinstance(value, type) else [('', value)])
             if inspect.isfunction(one)}
    text = json.dumps(_definition([codes, _constants(module)], set()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _constants(module: types.ModuleType) -> dict[str, Any]:
    """Return the present values of names to which a module assigns numbers, texts and the like.

    Those that its functions declare as global may change in each process.
    """
    try:
        tree = ast.parse(inspect.getsource(module))
    except (OSError, SyntaxError, TypeError):
        return {}
    changed = {name for node in ast.walk(tree) if isinstance(node, ast.Global)
               for name in node.names}
    names = set()
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            with contextlib.suppress(TypeError, ValueError):
                hash(ast.literal_eval(node.value))
                names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return {name: getattr(module, name, None) for name in sorted(names - changed)}
