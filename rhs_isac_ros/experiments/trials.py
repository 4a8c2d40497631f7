"""Running the jobs of an experiment so that nothing finished is ever done twice."""

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rhs_isac_ros import __version__
from rhs_isac_ros.experiments.jobs import Job, JobError, Outcome
from rhs_isac_ros.experiments.libraries import needed_for
from rhs_isac_ros.experiments.store import ResultStore
from rhs_isac_ros.experiments.workers import outcomes_here, outcomes_on_cluster


def run_jobs(
        function: Callable[..., dict[str, Any]], jobs: Sequence[Job], folder: Path,
        n_jobs: int = -1, dask: str | None = None) -> list[dict[str, Any]]:
    """Do the jobs whose results are not known yet, and show how far it is.

    Each result is kept as soon as it is there: after an interruption or an error, the same call
    goes on where this one ended.

    Parameters
    ----------
    function
        Takes the arguments of a job, and returns values by names that JSON can hold.
    jobs
        The jobs.
    folder
        Where the results are kept.
    n_jobs
        How many at a time on this machine; -1 for one on each core.
    dask
        Address of the scheduler of a Dask cluster to use instead.

    Returns
    -------
    list of dict
        Results in the order of the jobs, as JSON returns them.

    Raises
    ------
    ValueError
        If two jobs have the same name.
    JobError
        If a job fails, or its worker has another version of this package.
    ConnectionError
        If the cluster does not answer.
    OSError
        If a result cannot be read or kept.
    MissingLibraryError
        If a library is missing.
    """
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError('jobs: two of the same name, expected each name once')
    with needed_for('showing progress'):
        from tqdm import tqdm

    store = ResultStore(folder)
    known = {job.name: result for job in jobs if (result := store.read(job)) is not None}
    left = [job for job in jobs if job.name not in known]
    # Without a terminal, no bar.
    with tqdm(total=len(jobs), initial=len(known), unit='job', disable=None) as bar:
        if left:
            outcomes = (outcomes_on_cluster(function, left, dask) if dask
                        else outcomes_here(function, left, n_jobs))
            with contextlib.closing(outcomes):
                for outcome in outcomes:
                    known[outcome.job.name] = result = _result(outcome)
                    store.write(outcome.job, result)
                    bar.update()
    return [known[job.name] for job in jobs]


def _result(outcome: Outcome) -> dict[str, Any]:
    """The result of a job, or JobError if there is none that counts."""
    if outcome.error:
        raise JobError(f'job {outcome.job.name} failed: {outcome.error.strip()}')
    if outcome.version != __version__:
        raise JobError(f'job {outcome.job.name}: its worker has rhs_isac_ros {outcome.version}, '
                       f'expected {__version__} as here')
    return json.loads(outcome.text)
