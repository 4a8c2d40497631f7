"""Running jobs on the cores of this machine or on a Dask cluster."""

import contextlib
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any

from rhs_isac_ros.experiments.jobs import Job, JobError, JobResult, attempt
from rhs_isac_ros.model.optional import optional_import

# Timeout for the scheduler of a cluster, and for its first worker.
_TIMEOUT_S = 30
_THREAD_TIMEOUT_S = 5


def run_locally(
        function: Callable[..., Mapping[str, Any]], jobs: Sequence[Job], n_jobs: int
) -> Generator[JobResult, None, None]:
    """Run jobs in single-threaded processes on this machine; yield each result when it is ready.

    There are `n_jobs` processes: -1 selects one per core; 1 runs all jobs in this process.
    Closing the generator ends them. Before joblib 1.4, a result also waits for those of all
    earlier jobs.

    Raises
    ------
    JobError
        If a process dies.
    MissingLibraryError
        If joblib is not installed.
    """
    with optional_import('running jobs', extra='experiments'):
        import joblib

    results, threads_before = None, set(threading.enumerate())
    try:
        with _interrupts_ignored(), joblib.parallel_config(
                backend='loky', inner_max_num_threads=1):
            results = joblib.Parallel(
                n_jobs=n_jobs, batch_size=1, return_as=_return_as(joblib.__version__))(
                    joblib.delayed(attempt)(function, job) for job in jobs)
        # `yield from` would close the generator outside the filter for warnings below.
        while result := next(results, None):
            yield result
    except BrokenExecutor as error:
        raise JobError(f'a process died, possibly out of memory: {error}') from error
    finally:
        if results:
            with warnings.catch_warnings():
                # Joblib warns about lost jobs; here they are abandoned deliberately.
                warnings.simplefilter('ignore', UserWarning)
                results.close()
            # A thread of the pool that the end of the interpreter stops may be releasing a
            # semaphore, which the resource tracker of joblib then reports as leaked.
            for thread in set(threading.enumerate()) - threads_before:
                thread.join(_THREAD_TIMEOUT_S)


def run_on_cluster(
        function: Callable[..., Mapping[str, Any]], jobs: Sequence[Job], address: str
) -> Generator[JobResult, None, None]:
    """Run jobs on a Dask cluster; yield each result when it is ready.

    The address is that of the scheduler. Closing the generator cancels pending jobs. This uses
    `distributed` directly: through joblib, jobs for a cluster with a single thread run in this
    process instead, and the run never ends if a worker dies.

    Raises
    ------
    ConnectionError
        If there is no scheduler, or no worker.
    MissingLibraryError
        If distributed is not installed.
    """
    with optional_import('running jobs on a Dask cluster', extra='experiments'):
        from distributed import Client, as_completed

    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(  # type: ignore[no-untyped-call]
                address, timeout=_TIMEOUT_S, set_as_default=False))
            client.wait_for_workers(1, timeout=_TIMEOUT_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConnectionError(f'Dask cluster {address}: {error}') from error
        jobs_by_future = {
            client.submit(attempt, function, job, pure=False): job for job in jobs}
        for future in as_completed(  # type: ignore[no-untyped-call]
                list(jobs_by_future), loop=client.loop):
            try:
                yield future.result()
            except Exception as error:  # the job killed its worker or could not be sent to one
                yield JobResult(jobs_by_future[future], error=f'{type(error).__name__}: {error}')


def _return_as(version: str) -> str:
    """Return the option of a version of joblib that yields results as early as possible."""
    release = tuple(int(part) for part in version.split('.')[:2])
    return 'generator_unordered' if release >= (1, 4) else 'generator'


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore SIGINT inside the block, so that processes started there ignore it, too.

    A terminal sends SIGINT to the whole process group, but only this process may end the
    workers. Ignored signals are inherited. A blocked signal would be delivered after the block
    instead of being lost, but joblib unblocks it.
    """
    # Only the main thread can set handlers, and only there SIGINT raises KeyboardInterrupt.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
