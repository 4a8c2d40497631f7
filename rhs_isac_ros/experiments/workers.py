"""Where jobs run: on the cores of this machine or on a Dask cluster."""

import contextlib
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor

from rhs_isac_ros.experiments.jobs import Job, JobError, Outcome, attempt
from rhs_isac_ros.experiments.libraries import needed_for

# How long to wait for a cluster, and for a worker of it.
_PATIENCE_S = 30


def outcomes_here(function: Callable, jobs: Sequence[Job], n_jobs: int) -> Iterator[Outcome]:
    """Do jobs in processes of this machine, with one thread each.

    Parameters
    ----------
    function
        What does a job.
    jobs
        The jobs.
    n_jobs
        How many at a time; -1 for one on each core. One runs in this process.

    Yields
    ------
    Outcome
        Of each job, as it ends. Closing the iterator ends the processes.

    Raises
    ------
    JobError
        If a process dies.
    MissingLibraryError
        If joblib is missing.
    """
    with needed_for('running jobs'):
        import joblib

    outcomes = None
    try:
        with _interrupts_ignored(), joblib.parallel_config(
                backend='loky', inner_max_num_threads=1):
            outcomes = joblib.Parallel(
                n_jobs=n_jobs, batch_size=1, return_as='generator_unordered')(
                    joblib.delayed(attempt)(function, job) for job in jobs)
        # `yield from` would close it before `finally` does.
        while outcome := next(outcomes, None):
            yield outcome
    except BrokenExecutor as error:
        raise JobError(f'a process died, perhaps for lack of memory: {error}') from error
    finally:
        if outcomes:
            with warnings.catch_warnings():
                # Closed early, it warns that jobs are lost; whoever closes it knows.
                warnings.simplefilter('ignore', UserWarning)
                outcomes.close()


def outcomes_on_cluster(
        function: Callable, jobs: Sequence[Job], address: str) -> Iterator[Outcome]:
    """Do jobs on a Dask cluster.

    This is distributed's own interface: through joblib, jobs of a cluster with a single thread
    run here instead, and a worker that dies leaves the run waiting for ever.

    Parameters
    ----------
    function
        What does a job.
    jobs
        The jobs.
    address
        Address of the scheduler.

    Yields
    ------
    Outcome
        Of each job, as it ends. Closing the iterator takes back the jobs that have not begun.

    Raises
    ------
    ConnectionError
        If there is no scheduler, or no worker.
    MissingLibraryError
        If distributed is missing.
    """
    with needed_for('running jobs on a Dask cluster'):
        from distributed import Client, as_completed

    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(
                Client(address, timeout=_PATIENCE_S, set_as_default=False))
            client.wait_for_workers(1, timeout=_PATIENCE_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConnectionError(f'Dask cluster {address}: {error}') from error
        jobs_by_future = {
            client.submit(attempt, function, job, pure=False): job for job in jobs}
        for future in as_completed(list(jobs_by_future), loop=client.loop):
            try:
                yield future.result()
            except Exception as error:  # the job killed its worker, or never reached one
                yield Outcome(jobs_by_future[future], error=f'{type(error).__name__}: {error}')


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach.

    A terminal sends it to every process, and a new one inherits what is ignored. It is for this
    process alone to end the others. Blocking it would lose none, but joblib unblocks it.
    """
    # Only the main thread may choose, and only there does Ctrl-C end anything.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
