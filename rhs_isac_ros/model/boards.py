"""The boards that a scenario can name."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from rhs_isac_ros.model.board import Board, BoardError
from rhs_isac_ros.model.elementwise import Paper, PhaseShift, Resonant, States
from rhs_isac_ros.model.network import CoupledNetwork
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated

BUILT_IN: Mapping[str, Callable[..., Board]] = {
    'network': CoupledNetwork, 'paper': Paper, 'phase': PhaseShift, 'resonant': Resonant,
    'states': States}


def board_of(value: Any) -> Board:
    """Return a board, from its class, its name or a mapping of ``kind`` and fields of this kind.

    Names other than those of `BUILT_IN` are plug-ins: callables that take the fields and return a
    `Board`, or ``module:name`` of a subclass. Raises BoardError if the value does not describe a
    board.
    """
    if isinstance(value, type) and issubclass(value, Board):
        value = value()
    if isinstance(value, Board):
        name = value.plain if isinstance(value.plain, str) else value.plain['kind']
        key = plugins.key_of(plugins.BOARDS, name)
        if key not in plugins.LOADED and BUILT_IN.get(name) is not type(value):
            if name in BUILT_IN:
                raise BoardError(f'{type(value).__name__}: kind {name!r}, expected another one '
                                 'than that of a built-in board')
            plugins.give(key, type(value))
        return value
    fields = {'kind': value} if isinstance(value, str) else value
    if not isinstance(fields, Mapping) or not isinstance(kind := fields.get('kind'), str):
        raise BoardError(f'{value!r}, expected the name of a board, or a mapping with kind')
    options = {str(name): entry for name, entry in fields.items() if name != 'kind'}
    if (made := BUILT_IN.get(kind)) is None:
        with translated(plugins.PluginError, BoardError):
            board: Board = plugins.make(plugins.BOARDS, kind, Board, in_file=True, **options)
        board.__dict__['plain'] = value
        return board
    known = [field.name for field in dataclasses.fields(made)  # type: ignore[arg-type]
             if field.init]
    for name in options:
        if name not in known:
            raise BoardError(f'{name}: unknown field of {kind!r}, expected one of {known}')
    return made(**options)
