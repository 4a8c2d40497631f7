"""Running the jobs of an experiment; finished jobs are never repeated."""

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rhs_isac_ros import __version__
from rhs_isac_ros.experiments.jobs import Job, JobError, JobResult
from rhs_isac_ros.experiments.store import ResultStore
from rhs_isac_ros.experiments.workers import run_locally, run_on_cluster
from rhs_isac_ros.model.optional import optional_import


def run_jobs(
        function: Callable[..., dict[str, Any]], jobs: Sequence[Job], folder: Path,
        n_jobs: int = -1, dask: str | None = None, label: str = '') -> list[dict[str, Any]]:
    """Run the jobs that have no stored result; return all results in order, decoded from JSON.

    Each result is stored as soon as it is available. After an interruption or an error, the same
    call resumes the experiment. A progress bar is shown on a terminal.

    Parameters
    ----------
    function
        Callable that takes the arguments of a job and returns a dict that JSON can serialise.
    folder
        Folder of the stored results.
    n_jobs
        Number of parallel jobs on this machine; -1 for one per core.
    dask
        Address of the scheduler of a Dask cluster to use instead.
    label
        Label of the progress bar.

    Raises
    ------
    ValueError
        If two jobs have the same name.
    JobError
        If a job fails, or its worker has another version of this package.
    ConnectionError
        If the cluster does not respond.
    OSError
        If a result cannot be read or stored.
    MissingLibraryError
        If a library is not installed.
    """
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError('jobs: two have the same name, expected unique names')
    with optional_import('showing progress', extra='experiments'):
        from tqdm import tqdm

    store = ResultStore(folder)
    known = {job.name: result for job in jobs if (result := store.read(job)) is not None}
    pending = [job for job in jobs if job.name not in known]
    # None disables the bar if stderr is not a terminal.
    with tqdm(total=len(jobs), initial=len(known), unit='job', disable=None,
              desc=label or None) as bar:
        if pending:
            job_results = (run_on_cluster(function, pending, dask) if dask
                           else run_locally(function, pending, n_jobs))
            with contextlib.closing(job_results):
                for job_result in job_results:
                    known[job_result.job.name] = result = _decoded(job_result)
                    store.write(job_result.job, result)
                    bar.update()
    return [known[job.name] for job in jobs]


def _decoded(job_result: JobResult) -> dict[str, Any]:
    """Decode the result of a job, or raise JobError if it failed or ran in another version."""
    name = job_result.job.name
    if job_result.error:
        raise JobError(f'job {name} failed: {job_result.error.strip()}')
    if job_result.version != __version__:
        raise JobError(f'job {name}: the worker has rhs_isac_ros {job_result.version}, expected '
                       f'{__version__}, the version of this machine')
    result: dict[str, Any] = json.loads(job_result.text)
    return result
