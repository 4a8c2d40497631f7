"""Jobs on the cores of this machine or on a Dask cluster: options, runs, exit codes, tables."""

import argparse
import contextlib
import dataclasses
import json
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.support.arguments import integer, output_folder
from rhs_isac_ros.support.exits import print_error
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import


class JobError(Exception):
    """A job failed, its process died, or its worker has another version of this package."""


@dataclasses.dataclass(frozen=True)
class Job:
    """A call of an experiment's function with arguments that JSON or NumPy can represent.

    `run_jobs` converts those of NumPy to numbers and lists. `name` is the name of the result file
    without its suffix, unique in its folder.
    """

    name: str
    arguments: Mapping[str, Any]


class JobResult(NamedTuple):
    """The result of a job as JSON in `text`, or its error, with the package version used."""

    job: Job
    text: str = ''
    error: str = ''
    version: str = __version__


def attempt(function: Callable[..., Mapping[str, Any]], job: Job) -> JobResult:
    """Run a job in this process; return errors as text, because some errors cannot be pickled."""
    try:
        return JobResult(job, text=json.dumps(as_json(function(**job.arguments))))
    except MissingLibraryError as error:
        return JobResult(job, error=str(error))
    except Exception:
        return JobResult(job, error=traceback.format_exc())


def _stored(folder: Path, job: Job) -> dict[str, Any] | None:
    """Return the stored result of a job; None if it is missing, damaged or out of date."""
    try:
        record = json.loads(_file(folder, job).read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    if not isinstance(record, dict) or not isinstance(record.get('result'), dict):
        return None
    # As text, because 1, 1.0 and True are equal. JSON has no tuples.
    found, expected = (json.dumps(json.loads(json.dumps(one)), sort_keys=True)
                       for one in (record | {'result': {}}, _record(job, {})))
    return record['result'] if found == expected else None


def _record(job: Job, result: Mapping[str, Any]) -> dict[str, Any]:
    return {'version': __version__, 'arguments': dict(job.arguments), 'result': result}


def as_json(value: Any) -> Any:
    """Return a value in which numbers and arrays of NumPy are numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: as_json(entry) for key, entry in value.items()}
    return type(value)(map(as_json, value)) if type(value) in (list, tuple) else value


def _checked(job: Job) -> Job:
    """Return a job without values of NumPy; raise ValueError if JSON cannot represent one."""
    arguments = as_json(job.arguments)
    for name, value in arguments.items():
        try:
            json.dumps(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f'job {job.name}: {name}: {value!r}, expected numbers, texts, lists '
                             f'and mappings: {error}') from None
    return dataclasses.replace(job, arguments=arguments)


def _file(folder: Path, job: Job) -> Path:
    return folder / f'{job.name}.json'


# Timeouts for the scheduler of a cluster, its first worker, and a thread of the process pool.
_SCHEDULER_TIMEOUT_S = 30
_WORKER_TIMEOUT_S = 30
_THREAD_TIMEOUT_S = 5


def run_locally(
        function: Callable[..., Mapping[str, Any]], jobs: Sequence[Job], n_jobs: int
) -> Generator[JobResult, None, None]:
    """Run jobs in single-threaded processes on this machine; yield each result when it is ready.

    If `n_jobs` is -1, there is one process per core; if it is 1, all jobs run in this process.
    Closing the generator ends the processes. Joblib before 1.4 yields results in the jobs' order.
    """
    with optional_import('running jobs', extra='experiments'):
        import joblib

    release = tuple(int(part) for part in joblib.__version__.split('.')[:2])
    results, threads_before = None, set(threading.enumerate())
    try:
        with _interrupts_ignored(), joblib.parallel_config(
                backend='loky', inner_max_num_threads=1):
            results = joblib.Parallel(
                n_jobs=n_jobs, batch_size=1,
                return_as='generator_unordered' if release >= (1, 4) else 'generator')(
                    joblib.delayed(attempt)(function, job) for job in jobs)
        # `yield from` would close the generator outside of the filter for warnings below.
        while result := next(results, None):
            yield result
    except BrokenExecutor as error:
        raise JobError(f'a process died, possibly out of memory: {error}') from error
    finally:
        if results:
            with warnings.catch_warnings():
                # Joblib warns about lost jobs, which are abandoned deliberately here.
                warnings.simplefilter('ignore', UserWarning)
                results.close()
            # If the interpreter ended while a thread of the pool was releasing a semaphore, the
            # resource tracker of joblib would report a leak.
            for thread in set(threading.enumerate()) - threads_before:
                thread.join(_THREAD_TIMEOUT_S)


def run_on_cluster(
        function: Callable[..., Mapping[str, Any]], jobs: Sequence[Job], address: str,
        worker_timeout_s: float = _WORKER_TIMEOUT_S) -> Generator[JobResult, None, None]:
    """Run jobs on the Dask cluster of a scheduler; yield each result when it is ready.

    Closing the generator cancels pending jobs. This function uses `distributed` directly: joblib
    would never return if a worker died, and would run the jobs in this process if the cluster had
    a single thread.
    """
    with optional_import('running jobs on a Dask cluster', extra='experiments'):
        from distributed import Client, as_completed

    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(  # type: ignore[no-untyped-call]
                address, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False))
            client.wait_for_workers(1, timeout=worker_timeout_s)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConnectionError(f'Dask cluster {address}: {error}') from error
        jobs_by_future = {
            client.submit(attempt, function, job, pure=False): job for job in jobs}
        for future in as_completed(  # type: ignore[no-untyped-call]
                list(jobs_by_future), loop=client.loop):
            try:
                yield future.result()
            except Exception as error:  # The job killed its worker or could not be sent to one.
                yield JobResult(jobs_by_future[future], error=f'{type(error).__name__}: {error}')


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore SIGINT inside a block of the main thread, and in processes that are started there.

    A terminal sends SIGINT to the whole process group, but only this process may end the workers.
    A signal mask would not do: it would only delay the signal until the end of the block.
    """
    # Only the main thread can set handlers, and SIGINT raises KeyboardInterrupt only there.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def run_jobs(
        function: Callable[..., dict[str, Any]], jobs: Sequence[Job], folder: Path,
        n_jobs: int = -1, dask: str | None = None, label: str = '',
        worker_timeout_s: float = _WORKER_TIMEOUT_S) -> list[dict[str, Any]]:
    """Run the jobs that have no stored result; return all results in order, decoded from JSON.

    `function` takes the arguments of a job and returns a dict that JSON or NumPy can represent.
    Each result is stored as soon as it is available, in a file in `folder`. After an interruption
    or an error, the same call resumes the experiment. `n_jobs` jobs run in parallel on this
    machine, by default one per core; `dask` is the address of the scheduler of a Dask cluster to
    use instead, whose first worker may take `worker_timeout_s` to appear. If stderr is a terminal,
    a progress bar with the label appears there.

    Raises JobError if a job fails, its process dies or its worker has another version of this
    package, ConnectionError if the cluster does not respond, OSError if a result cannot be read or
    stored, MissingLibraryError if a library is not installed, and ValueError if two jobs have the
    same name, or JSON cannot represent an argument.
    """
    jobs = [*map(_checked, jobs)]
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError('jobs: two have the same name, expected unique names')
    with optional_import('showing progress', extra='experiments'):
        from tqdm import tqdm

    folder.mkdir(parents=True, exist_ok=True)
    known = {job.name: result for job in jobs if (result := _stored(folder, job)) is not None}
    pending = [job for job in jobs if job.name not in known]
    # None disables the bar unless stderr is a terminal.
    with tqdm(total=len(jobs), initial=len(known), unit='job', disable=None,
              desc=label or None) as bar:
        if pending:
            job_results = (run_on_cluster(function, pending, dask, worker_timeout_s) if dask
                           else run_locally(function, pending, n_jobs))
            with contextlib.closing(job_results):
                for job_result in job_results:
                    job = job_result.job
                    known[job.name] = result = _decoded(job_result)
                    write_whole(_file(folder, job),
                                json.dumps(_record(job, result), indent=1) + '\n')
                    bar.update()
    return [known[job.name] for job in jobs]


def _decoded(job_result: JobResult) -> dict[str, Any]:
    """Return the result of a job; raise JobError if it failed or ran with another version."""
    name = job_result.job.name
    if job_result.error:
        raise JobError(f'job {name} failed: {job_result.error.strip()}')
    if job_result.version != __version__:
        raise JobError(f'job {name}: the worker has rhs_isac_ros {job_result.version}, expected '
                       f'{__version__}, the version of this machine')
    return json.loads(job_result.text)


def add_run_options(parser: argparse.ArgumentParser, output: str) -> None:
    """Add the options of `run_jobs`; `output` is the default folder of the results."""
    parser.add_argument('--jobs', type=integer(1, 1024), default=-1, metavar='N',
                        help='number of parallel jobs (default: one per core)')
    parser.add_argument('--dask', type=_address, metavar='ADDRESS',
                        help='scheduler of a Dask cluster to use instead of this machine; '
                             'its workers need this package, and one thread each for '
                             'accurate timing')
    parser.add_argument('--output', type=output_folder, default=output, metavar='DIR',
                        help='folder of the results (default: %(default)s); jobs that have '
                             'results there are not repeated')


def _address(text: str) -> str:
    if not re.fullmatch(r'(\w+://)?[^\s/:]+:\d{1,5}', text):
        raise argparse.ArgumentTypeError(f'{text!r}, expected HOST:PORT')
    return text


def run_command(experiment: Callable[[], None]) -> int:
    """Run an experiment; return 0, 130 after Ctrl-C, or 1 after a job, file or library error."""
    try:
        experiment()
    except KeyboardInterrupt:
        print('interrupted: finished jobs are kept; repeat the command to resume',
              file=sys.stderr)
        # The exit code by which shells report Ctrl-C.
        return 130
    except (JobError, MissingLibraryError, OSError) as error:
        print_error(f'{error}; finished jobs are kept; repeat the command to resume')
        return 1
    return 0


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table: the first column is left-aligned, the others right-aligned."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ['-' * widths[0], *('-' * (width - 1) + ':' for width in widths[1:])]
    lines = [
        [entry.ljust(width) if column == 0 else entry.rjust(width)
         for column, (entry, width) in enumerate(zip(row, widths, strict=True))]
        for row in (header, rule, *rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)
