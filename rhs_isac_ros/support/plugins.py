"""Plug-ins: entry points in the metadata of other installed packages."""

from importlib import metadata
from typing import Any

# Groups of entry points; the page `extending` of the documentation specifies their objects.
IMPAIRMENTS = 'rhs_isac_ros.impairments'
ESTIMATORS = 'rhs_isac_ros.estimators'
MOBILITIES = 'rhs_isac_ros.mobilities'
GAIN_PATTERNS = 'rhs_isac_ros.gain_patterns'
BOARDS = 'rhs_isac_ros.boards'
SURFACES = 'rhs_isac_ros.surfaces'
RADIOS = 'rhs_isac_ros.radios'


class PluginError(ValueError):
    """A plug-in is not installed, cannot be loaded, or does not have the required interface."""


def names(group: str) -> tuple[str, ...]:
    """Return the sorted names of the plug-ins installed in a group of entry points."""
    return tuple(sorted({point.name for point in metadata.entry_points(group=group)}))


def describe(group: str, name: str) -> str:
    """Return a text for errors about a plug-in: group, name, object and package of each match."""
    return ' and '.join(sorted(
        f'entry point {group}: {name} = {point.value} of {point.dist.name if point.dist else "?"}'
        for point in metadata.entry_points(group=group, name=name)))


def load(group: str, name: str) -> Any:
    """Import the object of an entry point.

    Raises PluginError unless exactly one entry point has that name and its import succeeds.
    """
    points = tuple(metadata.entry_points(group=group, name=name))
    if not points:
        installed = ', '.join(names(group)) or 'none'
        raise PluginError(f'{name!r}, expected a plug-in of {group}; installed: {installed}')
    if len(points) > 1:
        raise PluginError(f'{name!r}: {describe(group, name)}, expected one')
    try:
        return points[0].load()
    # Importing a module of another package may raise any exception.
    except Exception as error:
        raise PluginError(
            f'{describe(group, name)}: cannot be loaded: {type(error).__name__}: {error}'
        ) from error


def make(group: str, name: str, *arguments: Any, **options: Any) -> Any:
    """Import the object of an entry point, call it, and return its result.

    Raises PluginError if the object cannot be loaded, or the call fails.
    """
    factory = load(group, name)
    try:
        return factory(*arguments, **options)
    # The call may raise any exception. Nodes show no traceback, so the message names the plug-in.
    except Exception as error:
        raise PluginError(
            f'{describe(group, name)}: failed: {type(error).__name__}: {error}') from error
