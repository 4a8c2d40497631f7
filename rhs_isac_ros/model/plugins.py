"""What other installed packages add by name: entry points of their metadata."""

from importlib import metadata
from typing import Any

# Groups of entry points; the page `extending` of the documentation says what each must be.
ESTIMATORS = 'rhs_isac_ros.estimators'
MOBILITIES = 'rhs_isac_ros.mobilities'
GAIN_PATTERNS = 'rhs_isac_ros.gain_patterns'


class PluginError(ValueError):
    """A plug-in is not there, cannot be loaded, or is not what it should be."""


def names(group: str) -> tuple[str, ...]:
    """List the plug-ins that are installed.

    Parameters
    ----------
    group
        Group of entry points.

    Returns
    -------
    tuple of str
        Their names, sorted.
    """
    return tuple(sorted({point.name for point in metadata.entry_points(group=group)}))


def describe(group: str, name: str) -> str:
    """Say where a plug-in comes from, for an error.

    Parameters
    ----------
    group
        Group of entry points.
    name
        Name of the plug-in.

    Returns
    -------
    str
        Group, name, object and package of every entry point of that name.
    """
    return ' and '.join(sorted(
        f'entry point {group}: {name} = {point.value} of {point.dist.name if point.dist else "?"}'
        for point in metadata.entry_points(group=group, name=name)))


def load(group: str, name: str) -> Any:
    """Import what a plug-in names.

    Parameters
    ----------
    group
        Group of entry points.
    name
        Name of the plug-in.

    Returns
    -------
    object
        The object of its entry point.

    Raises
    ------
    PluginError
        If there is none or more than one of that name, or it cannot be imported.
    """
    points = tuple(metadata.entry_points(group=group, name=name))
    if not points:
        there = ', '.join(names(group)) or 'none'
        raise PluginError(f'{name!r}, expected a plug-in of {group}; installed: {there}')
    if len(points) > 1:
        raise PluginError(f'{name!r}: {describe(group, name)}, expected one')
    try:
        return points[0].load()
    # Whatever the module of a stranger raises.
    except Exception as error:
        raise PluginError(
            f'{describe(group, name)}: cannot be loaded: {type(error).__name__}: {error}'
        ) from error


def make(group: str, name: str, *arguments: Any, **options: Any) -> Any:
    """Import what a plug-in names, and call it.

    Parameters
    ----------
    group
        Group of entry points.
    name
        Name of the plug-in.
    *arguments
        Arguments of the call.
    **options
        Named arguments of the call.

    Returns
    -------
    object
        What it returns.

    Raises
    ------
    PluginError
        If it cannot be loaded, or the call fails.
    """
    factory = load(group, name)
    try:
        return factory(*arguments, **options)
    # As above; the text alone must lead to the culprit, for a node shows no traceback.
    except Exception as error:
        raise PluginError(
            f'{describe(group, name)}: failed: {type(error).__name__}: {error}') from error
