"""Jobs: calls of a function with plain arguments and a stored result, on cores or a Dask cluster.

`run_jobs` runs independent jobs. Jobs that depend on the results of others belong to a `Strand`: a
generator that yields a function with its next jobs, receives their results, and returns its own.
`Workers.run` runs strands side by side. Each continues as soon as its own jobs are done.
"""

import contextlib
import ctypes
import dataclasses
import hashlib
import importlib.util
import json
import os
import queue
import signal
import sys
import threading
import time
import traceback
import types
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import
from rhs_isac_ros.support.progress import progress_bar
from rhs_isac_ros.support.sources import code_of, sources_of
from rhs_isac_ros.support.threads import keep_memory, one_blas_thread


class JobError(Exception):
    """A job failed, its process died, or its worker has other sources of this package."""


Function: TypeAlias = Callable[..., Mapping[str, Any]]


@dataclasses.dataclass(frozen=True)
class Job:
    """A call of an experiment's function with arguments that JSON or NumPy can represent.

    `run_jobs` converts those of NumPy to numbers and lists. `name` is the name of the result file
    without its suffix, unique in its folder.
    """

    name: str
    arguments: Mapping[str, Any]

    @classmethod
    def of(cls, kind: str, arguments: Mapping[str, Any]) -> 'Job':
        """Return a job whose name is a kind and a digest of the arguments."""
        plain = as_json(arguments)
        digest = hashlib.sha256(json.dumps(plain).encode()).hexdigest()
        return cls(f'{kind}-{digest[:24]}', plain)


class JobResult(NamedTuple):
    """The result of a job as JSON in `text`, or its error, with the sources of this package."""

    text: str = ''
    error: str = ''
    sources: str = ''


@one_blas_thread
def attempt(function: Function, job: Job,
            given: Mapping[tuple[str, str], Any] = types.MappingProxyType({}),
            modules: Mapping[str, str] = types.MappingProxyType({})) -> JobResult:
    """Run a job in this process; return errors as text, because some errors cannot be pickled.

    `given` are objects of the process that gets the result, to which names of plug-ins refer, by
    `plugins.key_of`, and `modules` the digests of modules by their names. A worker of a cluster
    may have loaded a module before it was edited.
    """
    for key, one in given.items():
        known = plugins.GIVEN.get(key)
        # A function arrives as another object with each job.
        if key[1] not in plugins.HELD and (known is None or sources_of(known) != sources_of(one)):
            plugins.give(key, one)
    try:
        result = function(**job.arguments)
        if not isinstance(result, Mapping):
            raise TypeError(f'{result!r}, expected a mapping as the result')
        for name, digest in modules.items():
            if name in sys.modules and code_of(sys.modules[name]) != digest:
                return JobResult(error=f'the worker has another version of the module {name}; '
                                       'restart the workers')
        return JobResult(json.dumps(as_json(result)), sources=sources_of())
    except MissingLibraryError as error:
        return JobResult(error=str(error))
    except Exception:
        return JobResult(error=traceback.format_exc())


def _stored(file: Path, record: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the stored result of a job; None if it is missing, damaged or of another record."""
    try:
        found = json.loads(file.read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    if not isinstance(found, dict) or not isinstance(result := found.pop('result', None), dict):
        return None
    return result if _as_text(found) == _as_text(record) else None


def _as_text(value: Mapping[str, Any]) -> str:
    """Return JSON, in which 1, 1.0 and True differ, but lists and tuples do not."""
    return json.dumps(json.loads(json.dumps(value)), sort_keys=True)


def as_json(value: Any) -> Any:
    """Return a value in which numbers and arrays of NumPy are numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: as_json(entry) for key, entry in value.items()}
    return type(value)(map(as_json, value)) if type(value) in (list, tuple) else value


def _check_keys(value: Any) -> None:
    """Raise TypeError unless all keys are texts: in JSON, 1 and '1' would be the same key."""
    if isinstance(value, Mapping):
        if wrong := [key for key in value if not isinstance(key, str)]:
            raise TypeError(f'key {wrong[0]!r}, expected texts as keys')
        value = [*value.values()]
    for one in value if isinstance(value, list | tuple) else ():
        _check_keys(one)


def _checked(job: Job) -> Job:
    """Return a job without values of NumPy; raise ValueError if it cannot be stored."""
    if not job.name or Path(job.name).name != job.name:
        raise ValueError(f'job {job.name!r}: expected the name of a file, without folders')
    arguments = as_json(job.arguments)
    for name, value in arguments.items():
        try:
            json.dumps(value)
            _check_keys(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f'job {job.name}: {name}: {value!r}, expected numbers, texts, lists '
                             f'and mappings: {error}') from None
    return dataclasses.replace(job, arguments=arguments)


def _file(folder: Path, job: Job) -> Path:
    return folder / f'{job.name}.json'


# Timeouts for the scheduler of a cluster and its first worker, and time after which a job notices
# that its client or parent has ended.
_SCHEDULER_TIMEOUT_S = 30
_WORKER_TIMEOUT_S = 30
_WATCH_S = 1.0
_POLL_S = 0.001
_ONE_THREAD = {f'{library}_NUM_THREADS': '1'
               for library in ('OMP', 'OPENBLAS', 'MKL', 'BLIS', 'VECLIB', 'NUMBA', 'NUMEXPR')}

_End = TypeVar('_End')
#: Yields a function with jobs, receives their results in the same order, and returns its own.
Strand: TypeAlias = Generator[tuple[Function, Sequence[Job]], list[dict[str, Any]], _End]


@dataclasses.dataclass(frozen=True)
class Workers:
    """Where jobs run, and where their results are kept."""

    #: Processes on this machine: 1 for this process, -1 for one per core if joblib is installed.
    n_jobs: int = 1
    dask: str | None = None  #: Scheduler of a Dask cluster to use instead, as ``HOST:PORT``.
    folder: Path | None = None  #: Folder of a file for each result; None to keep no results.
    label: str = ''  #: Text beside the progress.
    quiet: bool = False  #: Whether to show no progress.
    #: Files of the jobs so far in `folder`.
    files: set[Path] = dataclasses.field(default_factory=set, compare=False)

    def __post_init__(self) -> None:
        """Raise ValueError if there are no processes."""
        if not self.n_jobs:
            raise ValueError('n_jobs: 0, expected 1 or more, or -1 for one per core')

    def run(self, strands: Sequence[Strand[_End]]) -> list[_End]:
        """Run strands until all have returned; return what they return.

        Results do not depend on where the jobs run. Jobs of one name are one job, which runs once.
        Raises the errors of `run_jobs`, and those of the strands.
        """
        if self.folder:
            self.folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            show = stack.enter_context(progress_bar(
                0, 'job', quiet=self.quiet, label=self.label))
            state, done = _State(strands, self), queue.SimpleQueue[Future[JobResult]]()
            running: dict[Future[JobResult], _Entry] = {}
            executor, slots, has_started = None, 0, False
            while state.ready or running:
                if not executor:
                    executor, slots = stack.enter_context(self._executor())
                while state.ready and len(running) < slots:
                    entry = state.ready.popleft()
                    try:
                        # The first call starts the processes. Later ones must not lose Ctrl-C.
                        with (_interrupts_ignored() if slots > 1 and not has_started
                              else contextlib.nullcontext()):
                            future = executor.submit(
                                _attempt_on_cluster if self.dask else attempt, entry.function,
                                entry.job, entry.given, entry.modules)
                    except Exception as error:
                        raise _failure(entry.job, error) from error
                    running[future], has_started = entry, True
                    future.add_done_callback(done.put)
                future = done.get()
                entry = running.pop(future)
                state.take(entry, self._result(entry.job, future))
                if show:
                    show(state.n_done, '', len(state.entries))
            return [state.ends[number] for number in range(len(strands))]

    @contextlib.contextmanager
    def _executor(self) -> Iterator[tuple[Executor, int]]:
        """Yield an executor, and the number of jobs that it should have at a time."""
        if self.dask:
            with _cluster(self.dask) as executor:
                # The scheduler balances the load only among jobs that it knows.
                yield executor, sys.maxsize
            return
        if self.n_jobs == 1 or self.n_jobs < 0 and not importlib.util.find_spec('joblib'):
            yield _ThisProcess(), 1
            return
        with optional_import('running jobs', extra='experiments'):
            import joblib  # noqa: F401 - its absence is reported by name
            from joblib.externals import loky

        _start_tracker()
        number = loky.cpu_count() if self.n_jobs < 0 else self.n_jobs
        executor = loky.ProcessPoolExecutor(
            number, initializer=_begin_process, initargs=(os.getpid(),), env=_ONE_THREAD)
        try:
            yield executor, number
        finally:
            try:
                _await_calls(executor)
            finally:
                executor.shutdown(kill_workers=True)

    def _result(self, job: Job, future: 'Future[JobResult]') -> dict[str, Any]:
        """Return the result of a job; raise JobError if it failed or ran with other sources."""
        try:
            found = future.result()
        except CancelledError:
            raise ConnectionError(f'Dask cluster {self.dask}: connection lost') from None
        except Exception as error:  # The job killed its worker or could not be sent to one.
            raise _failure(job, error) from error
        if found.error:
            raise JobError(f'job {job.name} failed: {found.error.strip()}')
        if found.sources != sources_of():
            raise JobError(f'job {job.name}: the worker has rhs_isac_ros {found.sources}, '
                           f'expected {sources_of()}, that of this machine')
        return json.loads(found.text)


def _failure(job: Job, error: Exception) -> JobError:
    """Return the error of a job that a process could not receive, or did not return."""
    if isinstance(error, BrokenExecutor) and not error.__cause__:
        return JobError(f'a process died, possibly out of memory: {error}')
    # Only the last line of a traceback from another process names what cannot be pickled.
    cause = str(error.__cause__ or '').strip('\n "').rpartition('\n')[2]
    return JobError(f'job {job.name} failed: {type(error).__name__}: {error} {cause}')


#: Runs jobs in this process, and keeps no results.
HERE = Workers(quiet=True)


@dataclasses.dataclass(eq=False)
class _Entry:
    """A job with its result, if there is one, and the strands that wait for it."""

    function: Function
    job: Job
    record: Mapping[str, Any]  # What the result depends on.
    # Objects of this process to which names in the arguments refer.
    given: Mapping[tuple[str, str], Any]
    # Digests of modules of the function and plug-ins that other processes import, by name.
    modules: Mapping[str, str]
    result: dict[str, Any] | None = None
    waiting: list[int] = dataclasses.field(default_factory=list)


class _State:
    """Strands, the jobs they wait for, and jobs that are ready to run."""

    def __init__(self, strands: Sequence[Strand[Any]], workers: Workers) -> None:
        self.ready: deque[_Entry] = deque()
        self.ends: dict[int, Any] = {}
        self.n_done = 0
        self._strands, self._folder, self._files = strands, workers.folder, workers.files
        self.entries: dict[str, _Entry] = {}
        # By the identity of a function, which an entry keeps, and the names of plug-ins.
        self._sources: dict[tuple[Any, ...], str] = {}
        # The jobs that each strand waits for, and the number of those without a result.
        self._asked: dict[int, Sequence[_Entry]] = {}
        self._n_missing: dict[int, int] = {}
        for number in range(len(strands)):
            self._advance(number, None)

    def take(self, entry: _Entry, result: dict[str, Any]) -> None:
        """Keep the result of a job, and advance each strand that has waited only for this one."""
        if self._folder:
            write_whole(_file(self._folder, entry.job), json.dumps(
                {**entry.record, 'result': result}, indent=1) + '\n')
        entry.result = result
        self.n_done += 1
        for number in entry.waiting:
            self._n_missing[number] -= 1
            if not self._n_missing[number]:
                self._advance(number, [one.result for one in self._asked[number]])

    def _advance(self, number: int, results: Any) -> None:
        """Send results to a strand until it waits for a job."""
        while True:
            try:
                function, jobs = self._strands[number].send(results)
            except StopIteration as end:
                self.ends[number] = end.value
                return
            asked = [self._admitted(function, _checked(job)) for job in jobs]
            missing = [entry for entry in asked if entry.result is None]
            if missing:
                self._asked[number], self._n_missing[number] = asked, len(missing)
                for entry in missing:
                    entry.waiting.append(number)
                return
            results = [entry.result for entry in asked]

    def _admitted(self, function: Function, job: Job) -> _Entry:
        """Return a job, which is ready to run if it is new and has no stored result."""
        text = json.dumps(job.arguments)
        given = plugins.GIVEN | {('', name): one for name, one in plugins.HELD.items()}
        used = {key: plugin for key, plugin in (plugins.LOADED | given).items()
                if json.dumps(key[1]) in text}
        if (key := (id(function), *used)) not in self._sources:
            self._sources[key] = sources_of(function, *used.values())
        record = {'sources': self._sources[key], 'arguments': dict(job.arguments)}
        if known := self.entries.get(job.name):
            if _as_text(known.record) != _as_text(record):
                raise ValueError(f'jobs: two have the name {job.name}, expected unique names')
            return known
        entry = self.entries[job.name] = _Entry(function, job, record, {
            key: plugin for key, plugin in used.items() if key in given}, {
            name: code_of(sys.modules[name]) for name in {
                str(getattr(one, '__module__', '')) for one in (function, *used.values())}
            if name not in ('__main__', '') and hasattr(sys.modules.get(name), '__file__')
            and not name.startswith(f'{plugins.__name__.partition(".")[0]}.')})
        if self._folder:
            self._files.add(file := _file(self._folder, job))
            entry.result = _stored(file, record)
        if entry.result is None:
            self.ready.append(entry)
        else:
            self.n_done += 1
        return entry


class _ThisProcess(Executor):
    """Runs each call in this process before `submit` returns."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any
               ) -> 'Future[Any]':
        """Return a future that is done."""
        future: Future[Any] = Future()
        future.set_result(function(*arguments, **options))
        return future


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """Yield an executor on a Dask cluster; at the end, cancel its jobs.

    This function uses `distributed` directly: joblib would never return if a worker died.
    """
    with optional_import('running jobs on a Dask cluster', extra='experiments'):
        from distributed import Client

    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(
                address, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False))
            client.wait_for_workers(1, timeout=_WORKER_TIMEOUT_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConnectionError(f'Dask cluster {address}: {error}') from error
        yield client.get_executor()


class _AbandonedError(BaseException):
    """The client of a job has ended."""


def _attempt_on_cluster(
        function: Function, job: Job, given: Mapping[tuple[str, str], Any],
        modules: Mapping[str, str]) -> JobResult:
    """Run a job on a worker of a Dask cluster; end it if its client has ended.

    Dask itself only forgets such a job, which would occupy the worker until its end.
    """
    from distributed import get_worker

    worker, thread = get_worker(), threading.get_ident()
    key, over, lock = worker.get_current_task(), threading.Event(), threading.Lock()

    def watch() -> None:
        while not over.wait(_WATCH_S):
            task = worker.state.tasks.get(key)
            with lock:
                if (task is None or task.state != 'executing') and not over.is_set():
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(
                        ctypes.c_ulong(thread), ctypes.py_object(_AbandonedError))
                    return

    threading.Thread(target=watch, daemon=True).start()
    keep_memory()
    try:
        return attempt(function, job, given, modules)
    finally:
        with lock:
            over.set()


def _begin_process(parent: int) -> None:
    """Let a process ignore Ctrl-C, which its parent handles, and end with its parent."""
    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()


def _start_tracker() -> None:
    """Start the process of loky that removes semaphores, unless it runs, without its warnings.

    After the end of a program that Ctrl-C has interrupted, it may warn of semaphores that it
    removes, or that are already removed.
    """
    from joblib.externals.loky.backend import resource_tracker

    before = sys.warnoptions[:]
    sys.warnoptions.append('ignore:resource_tracker:UserWarning')
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions[:] = before


def _await_calls(executor: Executor) -> None:
    """Wait until processes have taken all calls so far, or have died.

    If loky kills its processes before its thread has seen a call, the thread fails, with a
    traceback on stderr. Calls are seen in their order, a last one after all others.
    """
    with contextlib.suppress(BrokenExecutor):
        last = executor.submit(os.getpid)
        while not (last.running() or last.done()):
            time.sleep(_POLL_S)


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


def results_of(
        function: Function, jobs: Sequence[Job]) -> Strand[list[dict[str, Any]]]:
    """Return the results of jobs, as a strand."""
    return (yield function, jobs)


def run_jobs(
        function: Callable[..., dict[str, Any]], jobs: Sequence[Job],
        folder: str | Path | None = None, n_jobs: int = -1, dask: str | None = None
) -> list[dict[str, Any]]:
    """Run the jobs that have no stored result; return all results in order, decoded from JSON.

    `function` takes the arguments of a job and returns a dict that JSON or NumPy can represent.
    Each result is stored as soon as it is available, in a file in `folder`. After an interruption
    or an error, the same call resumes the experiment. `n_jobs` jobs run in parallel on this
    machine, by default one per core; `dask` is the address of the scheduler of a Dask cluster to
    use instead. Progress appears on stderr.

    Raises JobError if a job fails, its process dies or its worker has other sources of this
    package, ConnectionError if the cluster does not respond, OSError if a result cannot be read or
    stored, MissingLibraryError if a library is not installed, and ValueError if two jobs have the
    same name, a name is not that of a file, or JSON cannot represent an argument.
    """
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError('jobs: two have the same name, expected unique names')

    (results,) = Workers(n_jobs, dask, Path(folder) if folder else None).run(
        [results_of(function, jobs)])
    return results
