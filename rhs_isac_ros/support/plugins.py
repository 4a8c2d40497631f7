"""Plug-ins: objects of other code, by entry points of installed packages, by module, or as such.

The name of a plug-in is that of an entry point, or ``module:name``. An object that a caller gives
in place of a name also has such a name, under which this process finds it again.
"""

import contextlib
import functools
import itertools
import sys
import traceback
import weakref
from collections.abc import Callable, Iterator
from importlib import import_module
from operator import attrgetter
from typing import Any, TypeVar

# Groups of entry points; the page `extending` of the documentation specifies their objects.
IMPAIRMENTS = 'rhs_isac_ros.impairments'
ESTIMATORS = 'rhs_isac_ros.estimators'
MOBILITIES = 'rhs_isac_ros.mobilities'
GAIN_PATTERNS = 'rhs_isac_ros.gain_patterns'
BOARDS = 'rhs_isac_ros.boards'
SURFACES = 'rhs_isac_ros.surfaces'
RADIOS = 'rhs_isac_ros.radios'
# Packages that call a plug-in or import it. Once `importlib_metadata` is imported, entry points of
# `importlib.metadata` are its objects.
_OWN = {__name__.partition('.')[0], 'importlib', 'importlib_metadata'}


class PluginError(ValueError):
    """A plug-in is not installed, cannot be loaded, or does not have the required interface."""


def _foreign(error: BaseException) -> list[traceback.FrameSummary]:
    """Return the frames of an error from the first one of the code of a plug-in."""
    names = (frame.f_globals.get('__name__', '') for frame, _ in traceback.walk_tb(
        error.__traceback__))
    own = itertools.takewhile(lambda name: name.partition('.')[0] in _OWN, names)
    return traceback.extract_tb(error.__traceback__)[len([*own]):]


def trace_of(error: BaseException | None) -> str:
    """Return the traceback of an error in other code, as lines that follow a text, or ''."""
    if error is None or not (frames := _foreign(error)):
        return ''
    lines = [*traceback.format_list(frames), *traceback.format_exception_only(error)]
    return '\nTraceback (most recent call last):\n' + ''.join(lines).rstrip()


@contextlib.contextmanager
def calling(place: object, *kept: type[Exception]) -> Iterator[None]:
    """Let a block that calls a plug-in, which may raise anything, only raise PluginError.

    The text of the error begins with `place`, and its cause is what the plug-in raised. Exceptions
    of the `kept` kinds, which belong to the interface of the plug-in, do not change.
    """
    try:
        yield
    except kept:
        raise
    except PluginError as error:
        raise type(error)(f'{place}: {error}') from error.__cause__
    except Exception as error:
        raise PluginError(f'{place}: {type(error).__name__}: {error}') from error


def _entry_points(**chosen: str) -> Any:
    # Few processes have plug-ins, and each would import this for a twentieth of a second.
    from importlib import metadata
    return metadata.entry_points(**chosen)


def names(group: str) -> tuple[str, ...]:
    """Return the sorted names of the plug-ins installed in a group of entry points."""
    return tuple(sorted({point.name for point in _entry_points(group=group)}))


def describe(group: str, name: Any) -> str:
    """Return a text for errors about a plug-in: group, name, object and package of each match."""
    if is_reference(name := name_of(name)):
        return name
    return ' and '.join(sorted(
        f'entry point {group}: {name} = {point.value} of {point.dist.name if point.dist else "?"}'
        for point in _entry_points(group=group, name=name)))


#: Objects that callers have given in place of names (see `give`), and loaded ones; see `key_of`.
GIVEN: dict[tuple[str, str], Any] = {}
LOADED: dict[tuple[str, str], Any] = {}
#: Objects without a name that scenarios of this process contain, by their texts.
HELD: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
# Functions that clear the caches of `cached`.
_CLEAR: list[Callable[[], None]] = []
_Function = TypeVar('_Function', bound=Callable[..., Any])


def cached(function: _Function, maxsize: int = 16) -> _Function:
    """Return a function with a cache of its last results, which use objects of plug-ins by name.

    Another object that takes a name, as a class that a notebook defines again, clears the cache.
    """
    made: Any = functools.lru_cache(maxsize)(function)
    _CLEAR.append(made.cache_clear)
    return made


def give(key: tuple[str, str], plugin: Any) -> None:
    """Let a name refer to an object; `key` is that of `key_of`."""
    if GIVEN.get(key) is not plugin:
        GIVEN[key] = plugin
        for clear in _CLEAR:
            clear()


def key_of(group: str, name: str) -> tuple[str, str]:
    """Return a group and a name; the group of ``module:name``, which has one object, is empty."""
    return '' if is_reference(name) else group, name


def is_reference(name: Any) -> bool:
    """Tell whether a name is ``module:name`` rather than that of an entry point."""
    return isinstance(name, str) and ':' in name


def name_of(plugin: Any) -> str:
    """Return the name of a plug-in, or of an object in its place, which must be callable."""
    if isinstance(plugin, str):
        return plugin
    if not callable(plugin):
        raise PluginError(f'{plugin!r}, expected a name, a class or a callable')
    name = (f'{getattr(plugin, "__module__", "?")}:'
            f'{getattr(plugin, "__qualname__", type(plugin).__qualname__)}')
    give(key_of('', name), plugin)
    return name


def load(group: str, plugin: Any, base: type | None = None) -> Any:
    """Return the object of a plug-in.

    If `base` is set, files may contain the name: ``module:name`` must then be a subclass of it or
    an instance, so that a file cannot call other code.

    Raises PluginError unless exactly one entry point has that name, or the module has the object,
    and its import succeeds.
    """
    name = name_of(plugin)
    key = key_of(group, name)
    if key in GIVEN:
        return GIVEN[key]
    module, is_named, attribute = name.partition(':')
    if base and is_named and module.partition('.')[0] in sys.stdlib_module_names:
        raise PluginError(f'{name}: expected a module outside of the standard library')
    points = () if is_named else tuple(_entry_points(group=group, name=name))
    if not (points or is_named):
        installed = ', '.join(names(group)) or 'none'
        raise PluginError(f'{name!r}, expected a plug-in of {group}; installed: {installed}')
    if len(points) > 1:
        raise PluginError(f'{name!r}: {describe(group, name)}, expected one')
    try:
        found = attrgetter(attribute)(import_module(module)) if is_named else points[0].load()
    # Importing a module of somebody else may raise any exception.
    except Exception as error:
        raise PluginError(f'{describe(group, name)}: cannot be loaded: {type(error).__name__}: '
                          f'{error}') from error
    if base and is_named and not isinstance(found, base) and not (
            isinstance(found, type) and issubclass(found, base)):
        raise PluginError(f'{name}: {found!r}, expected a subclass of {base.__name__}')
    LOADED[key] = found
    return found


def make(group: str, plugin: Any, kind: type, /, *arguments: Any, in_file: bool = False,
         **options: Any) -> Any:
    """Call the object of a plug-in, and return its result, which must be a `kind`.

    If files may contain the name (`in_file`), `kind` is also the `base` of `load`. Raises
    PluginError if the object cannot be loaded, the call fails, or the result is of another kind.
    """
    factory = load(group, plugin, kind if in_file else None)
    with calling(f'{describe(group, plugin)}: failed'):
        made = factory(*arguments, **options)
    if not isinstance(made, kind):
        members = sorted({*dir(kind), *getattr(kind, '__annotations__', ())})
        listed = ', '.join(member for member in members if not member.startswith('_'))
        raise PluginError(f'{describe(group, plugin)}: returned {made!r}, expected an object with '
                          f'{listed}, as of {kind.__name__}')
    return made
