"""Calibrations, surveys and comparisons of boards from pilots, as jobs.

Jobs read the pilots from a file, and return what JSON can represent; estimates are the bytes of
their files.
"""

import base64
import dataclasses
import json
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.calibration import (
    CalibrationError,
    CalibrationWarning,
    Pilots,
    SurveyWarning,
    board_evidence,
    calibrate,
    fit_board,
    load_surface,
    survey,
)
from rhs_isac_ros.calibration.estimate import places_of
from rhs_isac_ros.calibration.survey import PLACE_WAVELENGTHS
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MultipathEstimate, Scenario
from rhs_isac_ros.model.arrays import digest
from rhs_isac_ros.model.boards import board_of
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.files import read_arrays, write_archive
from rhs_isac_ros.support.jobs import Job, Workers, results_of

# Maximum number of pilots whose errors before and after the calibration are compared, and number
# of groups of places that are left out one by one.
_N_COMPARED, _N_FOLDS = 200, 5
_FIELDS = ('positions', 'received')


class Found(NamedTuple):
    """An estimate from pilots, as the content of its file, and errors at left-out places."""

    archive: bytes
    before_m: np.ndarray  #: Position errors without the estimate; NaN without a fix.
    after_m: np.ndarray  #: Position errors with the estimate from the pilots of other places.

    @property
    def is_worse(self) -> bool:
        """Whether significantly more pilots are located worse with the estimate than better."""
        before, after = (np.where(np.isnan(one), np.inf, one)
                         for one in (self.before_m, self.after_m))
        n_worse, n_better = int(np.sum(after > before)), int(np.sum(after < before))
        return bool(n_worse - n_better > 2 * np.sqrt(n_worse + n_better))


class PilotWork:
    """What jobs compute from pilots of one surface; `folder` is that of the workers.

    Every worker must be able to read the files of this folder, and of the scenario. All methods
    raise CalibrationError if the pilots do not fit the scenario.
    """

    def __init__(self, workers: Workers, scenario: Scenario, pilots: Sequence[Pilots]) -> None:
        assert workers.folder
        workers.folder.mkdir(parents=True, exist_ok=True)
        workers.files.add(file := (workers.folder / 'pilots.npz').resolve())
        arrays = {f'{name}_{number}': getattr(group, name)
                  for number, group in enumerate(pilots) for name in _FIELDS}
        beams = [group.beams for group in pilots]
        assert all(isinstance(one, Codebook) for one in beams)
        write_archive(file, arrays, {'codebooks': [
            one.to_parameters() for one in beams if isinstance(one, Codebook)]})
        self._workers = workers
        self._known = {'scenario': scenario.changes(), 'file': str(file), 'digests': [
            *map(digest, arrays.values()), *(str(getattr(one, 'id', '')) for one in beams)]}

    def estimate(self, multipath: bool, calibration: Path | None = None) -> Found:
        """Estimate the surface, or the multipath with a calibrated surface, and test it."""
        known = {'multipath': multipath,
                 'calibration': str(calibration.resolve()) if calibration else ''}
        whole, *errors = self._run('estimate', [known], 'errors', [
            {**known, 'fold': fold, 'after': after}
            for after in (False, True) for fold in range(_N_FOLDS)])
        distances = [np.array(one['distances'], float) for one in errors]
        return Found(base64.b64decode(whole['archive']), np.concatenate(distances[:_N_FOLDS]),
                     np.concatenate(distances[_N_FOLDS:]))

    def evidence(self, boards: Sequence[Any]) -> list[float]:
        """Return the logarithms of the evidence of boards, given as their `plain` values."""
        return [one['log_evidence'] for one in self._run('evidence', [
            {'board': board} for board in boards])]

    def fit(self, board: Any, names: Sequence[str]) -> dict[str, Any]:
        """Fit fields of a board, given as its `plain` value; return names, values and so on."""
        (found,) = self._run('fit', [{'board': board, 'names': [*names]}])
        return found

    def _run(self, *tasks: Any) -> list[dict[str, Any]]:
        """Run pairs of a task and the options of its jobs, side by side."""
        jobs = [Job.of(task, {**self._known, 'task': task, **each})
                for task, options in zip(tasks[::2], tasks[1::2], strict=True)
                for each in options]
        (found,) = self._workers.run([results_of(answered, jobs)])
        for one in found:
            if 'refused' in one:
                raise CalibrationError(one['refused'])
        return found


def answered(task: str, scenario: Mapping[str, Any], file: str, digests: Sequence[str],
             **options: Any) -> dict[str, Any]:
    """Run a job; an error in the pilots is its result."""
    # The reports contain these warnings.
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', CalibrationWarning)
        warnings.simplefilter('ignore', SurveyWarning)
        try:
            return _TASKS[task](Scenario(**scenario), _pilots(file), **options)
        except ValueError as error:
            return {'refused': str(error)}


def _pilots(file: str) -> list[Pilots]:
    arrays = read_arrays(file)
    return [Pilots(Codebook.from_parameters(codebook), *(
        arrays[f'{name}_{number}'] for name in _FIELDS))
        for number, codebook in enumerate(json.loads(str(arrays['about']))['codebooks'])]


def _surveyed(scenario: Scenario, pilots: Sequence[Pilots], surface: SurfaceEstimate | None
              ) -> MultipathEstimate:
    (group,) = pilots
    return survey(scenario, group.beams, group.positions, group.received, surface)


def _estimate(scenario: Scenario, pilots: Sequence[Pilots], multipath: bool, calibration: str
              ) -> dict[str, Any]:
    found = (_surveyed(scenario, pilots, load_surface(calibration, scenario)) if multipath
             else calibrate(scenario, pilots))
    with tempfile.TemporaryDirectory() as folder:
        found.save(path := Path(folder) / 'found.npz')
        return {'archive': base64.b64encode(path.read_bytes()).decode()}


def _errors(scenario: Scenario, pilots: Sequence[Pilots], multipath: bool, calibration: str,
            fold: int, after: bool) -> dict[str, Any]:
    """Return the position errors at places that were left out, NaN without a fix."""
    surface = load_surface(calibration, scenario)
    distances = [np.empty(0)]
    for others, left_out in [*_folds(scenario, pilots)][fold:fold + 1]:
        assumed = scenario
        if after and multipath:
            assumed = dataclasses.replace(scenario, multipath=_surveyed(
                scenario, others, surface))
        elif after:
            surface = calibrate(scenario, others).surface
        for group in left_out:
            assert isinstance(group.beams, Codebook)
            estimator = make_estimator('bayes', assumed, group.beams, surface=surface)
            errors = estimator.estimate(group.received).mean - group.positions
            distances.append(np.linalg.norm(errors, axis=1))
    return {'distances': np.concatenate(distances)}


def _evidence(scenario: Scenario, pilots: Sequence[Pilots], board: Any) -> dict[str, Any]:
    return {'log_evidence': board_evidence(scenario, pilots, board_of(board))}


def _fit(scenario: Scenario, pilots: Sequence[Pilots], board: Any, names: Sequence[str]
         ) -> dict[str, Any]:
    fit = fit_board(dataclasses.replace(scenario, board=board), pilots, names)
    return {**fit._asdict(), 'board': fit.board.plain,
            'log_evidence': board_evidence(scenario, pilots, fit.board)}


_TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    'estimate': _estimate, 'errors': _errors, 'evidence': _evidence, 'fit': _fit}


def _folds(scenario: Scenario, pilots: Sequence[Pilots]
           ) -> Iterator[tuple[list[Pilots], list[Pilots]]]:
    """Leave groups of places out one by one; yield the pilots at other places, and those left out.

    At most about `_N_COMPARED` pilots are left out in total.
    """
    positions = np.concatenate([group.positions for group in pilots])
    fold_of = np.empty(len(positions), int)
    for number, place in enumerate(places_of(scenario, positions, PLACE_WAVELENGTHS)):
        fold_of[place] = number % _N_FOLDS
    step = -(-len(positions) // _N_COMPARED)
    parts = np.split(fold_of, np.cumsum([len(group.positions) for group in pilots])[:-1])

    def chosen(rows: list[np.ndarray]) -> list[Pilots]:
        return [Pilots(group.beams, group.positions[some], group.received[some])
                for group, some in zip(pilots, rows, strict=True) if len(some)]

    for fold in range(_N_FOLDS):
        others = chosen([np.flatnonzero(part != fold) for part in parts])
        left_out = chosen([np.flatnonzero(part == fold)[::step] for part in parts])
        if others and left_out:
            yield others, left_out
