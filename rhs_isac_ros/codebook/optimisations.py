"""Optimisations as jobs, with arguments and results that are plain values."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rhs_isac_ros.calibration import Calibration
from rhs_isac_ros.codebook.cell import REGION, Cell
from rhs_isac_ros.codebook.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.optimize import INTERRUPTED, OptimizeResult, optimize
from rhs_isac_ros.codebook.problem import Progress
from rhs_isac_ros.codebook.unoptimised import random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.jobs import Job, Strand


def optimisation(
        scenario: Scenario, *, start: Codebook | None = None, cell: Cell | None = None,
        calibration: Path | None = None, **options: Any) -> Job:
    """Return a job of `optimised`; the options are those of `optimize`.

    Every worker must be able to read the file of a calibration.
    """
    given = {'start': start and start.to_parameters(), 'cell': cell and dataclasses.astuple(cell),
             'calibration': calibration and (
                 str(calibration.resolve()), Calibration.load(calibration).id)}
    return Job.of('optimisation', {
        'scenario': scenario.changes(), **options,
        **{name: value for name, value in given.items() if value}})


def optimised(
        scenario: Mapping[str, Any], start: Mapping[str, Any] | None = None,
        cell: Sequence[Any] | None = None, calibration: Sequence[str] | None = None,
        **options: Any) -> dict[str, Any]:
    """Run a job: optimise a codebook, and return it with the history and the reason for the end.

    Raises KeyboardInterrupt after Ctrl-C: an unfinished optimisation is no result.
    """
    surface = Calibration.load(calibration[0]) if calibration else None
    if surface and calibration and surface.id != calibration[1]:
        raise CodebookError(f'{calibration[0]}: {surface.id}, expected {calibration[1]}')
    centre_m, std_m = cell or ((0.0, 0.0, 0.0), 0.0)
    result = optimize(
        Scenario(**scenario), start=Codebook.from_parameters(dict(start)) if start else None,
        prior=Cell((centre_m[0], centre_m[1], centre_m[2]), std_m) if cell else REGION,
        calibration=surface, **options)
    if result.reason == INTERRUPTED:
        raise KeyboardInterrupt
    return {'codebook': result.codebook.to_parameters(), 'reason': result.reason,
            'history': [dataclasses.astuple(entry) for entry in result.history]}


def result_of(found: Mapping[str, Any]) -> OptimizeResult:
    """Return the result of a job of `optimised`."""
    return OptimizeResult(
        Codebook.from_parameters(dict(found['codebook'])),
        tuple(Progress(*entry) for entry in found['history']), found['reason'])


def restarted(scenario: Scenario, n: int, seed: int = 0, **options: Any) -> Strand[OptimizeResult]:
    """Optimise with the same samples from `n` random starts; return the result of lowest value.

    The first start is that of `optimize`, whose options the others are.
    """
    starts = [None, *(random_codebook(scenario, streams.generator(seed, streams.START, number))
                      for number in range(1, n))]
    jobs = [optimisation(scenario, **options | ({'start': start} if start else {}), seed=seed)
            for start in starts]
    results = map(result_of, (yield optimised, jobs))
    return min(results, key=lambda result: result.history[-1].value_m2)
