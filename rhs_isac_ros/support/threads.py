"""Threads of the numerical functions of the package, and the memory of their arrays.

Most matrix products here are so small that the threads of BLAS spend more time waiting for each
other than computing. If another process occupies a core, a call with several threads takes up to
fifty times as long as with one. Public functions therefore run BLAS with one thread
(`one_blas_thread`). Large tasks are divided into blocks, which run in parallel (`map_blocks`).
"""

import contextlib
import ctypes
import functools
import importlib.util
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias, TypeVar

import numpy  # noqa: F401 - loads the BLAS that `one_blas_thread` limits
from threadpoolctl import ThreadpoolController

_Item = TypeVar('_Item')
_Result = TypeVar('_Result')
# A BLAS library in threadpoolctl, which has no type annotations.
_Library: TypeAlias = Any
# Parameters of mallopt in glibc, and the largest values that glibc itself would choose [bytes].
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_TRIM_BYTES, _MMAP_BYTES = 1 << 26, 1 << 25


@functools.cache
def keep_memory() -> None:
    """Let this process keep the memory of arrays that are freed, as without a setting of glibc.

    The workers of Dask have the setting ``MALLOC_TRIM_THRESHOLD_``, with which every temporary
    array above 128 kB comes from the system anew: most of the time goes into clearing its pages.
    """
    if 'MALLOC_TRIM_THRESHOLD_' in os.environ:
        # Other C libraries do not have the function.
        with contextlib.suppress(AttributeError):
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES)
            mallopt(_M_TRIM_THRESHOLD, _TRIM_BYTES)


class _OneBlasThread(contextlib.ContextDecorator):
    """Context manager and decorator that runs BLAS with one thread.

    The number of threads is a setting of the process: the first caller to enter changes it, and
    the last one to leave restores it unless it was changed in between. In libraries that use
    OpenMP, each thread has its own setting, which every calling thread changes and restores.
    """

    def __init__(self) -> None:
        self._lock, self._own = threading.Lock(), threading.local()
        self._depth = 0
        self._shared: list[_Library] = []
        self._per_thread: list[_Library] = []
        self._saved: list[tuple[_Library, int]] = []
        self.find_libraries()

    def __enter__(self) -> None:
        with self._lock:
            if not self._depth:
                self._saved += _limit(self._shared)
            self._depth += 1
        depth = getattr(self._own, 'depth', 0)
        if not depth:
            self._own.saved = _limit(self._per_thread)
        self._own.depth = depth + 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        # A child process begins with no callers, even if its parent forked inside a call.
        depth = getattr(self._own, 'depth', 0)
        if depth == 1:
            _restore(self._own.saved)
        self._own.depth = max(depth - 1, 0)
        with self._lock:
            self._depth = max(self._depth - 1, 0)
            if not self._depth:
                _restore(self._saved)
                self._saved = []

    def allowed(self) -> int:
        """Return the number of threads that BLAS may use outside of this context."""
        with self._lock:
            saved = [*self._saved, *getattr(self._own, 'saved', ())]
        numbers = [number for _, number in saved]
        numbers += [library.get_num_threads() or 1
                    for library in (*self._shared, *self._per_thread)]
        return max(numbers, default=1)

    def after_fork(self) -> None:
        """Restore the settings in a child process, which begins with no callers."""
        self._lock, self._own, self._depth = threading.Lock(), threading.local(), 0
        _restore(self._saved)
        self._saved = []

    def find_libraries(self) -> None:
        """Find the BLAS libraries that the process has loaded, and that of SciPy.

        The search holds the lock of the dynamic loader and needs the lock of the interpreter, so
        it would deadlock with a thread that is importing an extension module. It therefore runs
        only while this module is imported.
        """
        _load_blas_of_scipy()
        found = ThreadpoolController().select(user_api='blas').lib_controllers
        self._per_thread = [library for library in found
                            if getattr(library, 'threading_layer', '') == 'openmp']
        self._shared = [library for library in found if library not in self._per_thread]


def _load_blas_of_scipy() -> None:
    """Load the BLAS in SciPy's wheel, which takes milliseconds, but not SciPy itself.

    Functions import SciPy when they first need it, also while other threads import modules.
    """
    spec = importlib.util.find_spec('scipy')
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        for file in (*Path(folder).parent.glob('scipy.libs/*openblas*'),
                     *Path(folder).glob('.dylibs/*openblas*')):
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(file))


def _limit(libraries: Iterable[_Library]) -> list[tuple[_Library, int]]:
    """Set libraries to one thread; return those that had more, with their former numbers."""
    saved = [(library, number) for library in libraries
             if (number := library.get_num_threads() or 1) > 1]
    for library, _ in saved:
        _set(library, 1)
    return saved


def _restore(saved: Iterable[tuple[_Library, int]]) -> None:
    for library, number in saved:
        if library.get_num_threads() == 1:
            _set(library, number)


def _set(library: _Library, number: int) -> None:
    library.set_num_threads(number)
    # Since threadpoolctl 3.7, only the thread that first set a number can change it, until it
    # releases control. Here, the last thread restores the number that the first one changed.
    release = getattr(library, 'clear_controlling_thread', None)
    if release:
        release()


one_blas_thread = _OneBlasThread()
if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=one_blas_thread.after_fork)


def map_blocks(
        function: Callable[[_Item], _Result], blocks: Sequence[_Item],
        progress: Callable[[float], None] | None = None) -> list[_Result]:
    """Call a function with each block, on as many threads as BLAS may use, at most one per core.

    The results have the order of the blocks and do not depend on the number of threads. A limit of
    BLAS, such as ``OPENBLAS_NUM_THREADS``, also applies here. The function must not change data
    that other blocks use. `progress` is called with the completed share, from any thread.
    """
    if progress:
        done = itertools.count(1)

        def reported(block: _Item) -> _Result:
            result = function(block)
            progress(next(done) / len(blocks))
            return result

        return map_blocks(reported, blocks)
    with one_blas_thread:
        is_serial = len(blocks) < 2 or getattr(_worker, 'busy', False)
        n_threads = 1 if is_serial else min(
            one_blas_thread.allowed(), _n_cores(), len(blocks))
        if n_threads < 2:
            return [function(block) for block in blocks]
        with ThreadPoolExecutor(n_threads, initializer=_mark_worker) as pool:
            return list(pool.map(one_blas_thread(function), blocks))


# Whether the current thread belongs to `map_blocks`, whose functions start no further threads.
_worker = threading.local()


def _mark_worker() -> None:
    _worker.busy = True


def _n_cores() -> int:
    # Not every system can bind a process to some of the cores.
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
