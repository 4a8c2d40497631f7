"""The board of a surface, from pilots of a reference user at known positions.

Boards are compared by their evidence: the density of the pilots, with impairments integrated out.
The parameters of a board maximise the evidence.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.calibration.estimate import (
    Pilots,
    check_pilots,
    log_evidence,
    places_of,
    weights_of,
)
from rhs_isac_ros.calibration.survey import PLACE_WAVELENGTHS
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.board import Board, BoardError
from rhs_isac_ros.support.threads import one_blas_thread

# First step of the derivatives by logarithms of parameters, the least second derivative that
# determines further steps, and the step of slopes in these units.
_STEP, _LEAST, _SHIFT = 1e-4, 25.0, 0.1
# Minus the evidence of parameters that the board refuses.
_REFUSED = 1e12


class BoardFit(NamedTuple):
    """A board whose parameters fit pilots.

    `names` are those of its P parameters, with the number of the entry for a list; `values` are
    float64 [P], and `covariance` is their covariance, float64 [P, P].
    """

    board: Board
    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray


@one_blas_thread
def board_evidence(scenario: Scenario, pilots: Sequence[Pilots], board: Board) -> float:
    """Return the logarithm of the evidence of a board, without a constant.

    Pilots of one place share a weight of 1. Raises ValueError if the board does not fit the
    scenario, or pilots are not those of its region.
    """
    check_pilots(scenario, pilots)
    assumed, total = dataclasses.replace(scenario, board=board), 0.0
    for group in pilots:
        places = places_of(scenario, group.positions, PLACE_WAVELENGTHS)
        weights = weights_of(places, np.ones(len(group.positions), bool))
        total += weights @ log_evidence(MeasurementModel(assumed, group.beams), group)
    return float(total)


def fit_board(scenario: Scenario, pilots: Sequence[Pilots], names: Sequence[str]) -> BoardFit:
    """Fit fields of a scenario's board, which are positive numbers or lists of them, to pilots.

    The search begins at the declared values, or at 1 for a value of 0, and finds the nearest
    maximum of the evidence. The covariance is that of a Gaussian with the same curvature. Raises
    ValueError if the board has no such field, or the pilots are not those of the region.
    """
    from scipy.optimize import minimize

    starts = {name: _start(scenario, name) for name in names}
    begin, ends = np.concatenate([*starts.values()]), np.cumsum([*map(len, starts.values())])

    def board_at(logarithms: np.ndarray) -> Board:
        parts = zip(starts, np.split(np.exp(logarithms), ends[:-1]), strict=True)
        return dataclasses.replace(scenario.board, **{  # type: ignore[type-var]
            name: part.tolist() if _is_list(scenario, name) else float(part[0])
            for name, part in parts})

    def loss(logarithms: np.ndarray) -> float:
        try:
            return -board_evidence(scenario, pilots, board_at(logarithms))
        except BoardError:
            return _REFUSED

    begin = np.log(np.where(begin > 0, begin, 1.0))
    units = _derivatives(loss, begin)[0]

    def scaled(steps: np.ndarray) -> float:
        return loss(begin + units * steps)

    def slopes(steps: np.ndarray) -> np.ndarray:
        return np.array([scaled(steps + one) - scaled(steps - one)
                         for one in _SHIFT * np.eye(len(steps))]) / (2 * _SHIFT)

    found = begin + units * minimize(scaled, np.zeros(len(begin)), jac=slopes, method='L-BFGS-B',
                                     options={'ftol': 0.0, 'gtol': 1e-2}).x
    labels = tuple(f'{name}[{k}]' if _is_list(scenario, name) else name
                   for name, start in starts.items() for k in range(len(start)))
    values = np.exp(found)
    covariance = np.linalg.pinv(_derivatives(loss, found)[1]) * np.outer(values, values)
    return BoardFit(board_at(found), labels, values, covariance)


def _derivatives(function: Callable[[np.ndarray], float], point: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Compute the second derivatives [P, P] from steps [P] of about a standard deviation."""
    steps, second = np.full(len(point), _STEP), np.empty((len(point),) * 2)
    for _ in range(2):
        moves = np.diag(steps)
        for row, one in enumerate(moves):
            for column, other in enumerate(moves[:row + 1]):
                second[row, column] = second[column, row] = (
                    function(point + one + other) - function(point + one - other)
                    - function(point - one + other) + function(point - one - other)
                ) / (4 * steps[row] * steps[column])
        used, steps = steps, 1 / np.sqrt(np.maximum(np.diagonal(second), _LEAST))
    return used, second


def _is_list(scenario: Scenario, name: str) -> bool:
    return np.ndim(_declared(scenario.board, name, scenario)) == 1


def _declared(board: Board, name: str, scenario: Scenario) -> Any:
    """Return the value of a field, or what None stands for."""
    value = getattr(board, name) if name in getattr(board, '__dataclass_fields__', ()) else None
    return board.implied(name, scenario) if value is None else value


def _start(scenario: Scenario, name: str) -> np.ndarray:
    """Return the values of a field with which the search begins, float64 [1 or more]."""
    value = _declared(scenario.board, name, scenario)
    if (name == 'masked' or not isinstance(value, float | tuple | list) or np.ndim(value) > 1
            or min(np.atleast_1d(value)) < 0):
        raise ValueError(f'{name}: expected a field of the board {scenario.board.kind!r} that '
                         'contains positive numbers')
    return np.atleast_1d(np.asarray(value, float))
