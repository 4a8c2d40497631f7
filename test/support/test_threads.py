"""Public functions run BLAS with one thread and leave the setting of the process as it was.

Workers of Dask keep the memory of temporary arrays.
"""

import os
import platform
import subprocess
import sys
import threading

import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from rhs_isac_ros.support import threads
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread

BLAS = ThreadpoolController().select(user_api='blas').lib_controllers
TIMEOUT_S = 30


def numbers():
    return [library.get_num_threads() for library in BLAS]


def allow(number):
    for library in BLAS:
        library.set_num_threads(number)
        # Otherwise, only this thread could change the setting.
        getattr(library, 'clear_controlling_thread', lambda: None)()


@pytest.fixture(autouse=True)
def three_threads():
    """A process in which BLAS may use three threads."""
    if not BLAS:
        pytest.skip('NumPy has no BLAS whose threads can be limited')
    with threadpool_limits(3, user_api='blas'):
        if set(numbers()) != {3}:
            pytest.skip('BLAS cannot use three threads here')
        # The setting now belongs to the test, not to this context.
        allow(3)
        yield


def test_only_the_block_has_one_thread():
    with one_blas_thread:
        assert set(numbers()) == {1}
        with one_blas_thread:
            assert set(numbers()) == {1}
        assert set(numbers()) == {1}
    assert set(numbers()) == {3}


def test_a_block_does_not_search_for_libraries(monkeypatch):
    """A search would block if another thread imports an extension module at that time."""
    monkeypatch.setattr(threads, 'ThreadpoolController', None)
    with one_blas_thread:
        assert map_blocks(abs, [-1, -2]) == [1, 2]


def test_scipy_has_one_thread_even_if_a_block_is_the_first_to_import_it():
    """Its wheel has a BLAS of its own: with other processes, 64 eigenvectors took a minute."""
    done = subprocess.run([sys.executable, '-c', '''
from threadpoolctl import ThreadpoolController, threadpool_limits
from rhs_isac_ros.support.threads import one_blas_thread

def numbers():
    found = ThreadpoolController().select(user_api='blas').lib_controllers
    return {library.filepath: library.get_num_threads() for library in found}

with threadpool_limits(3, user_api='blas'):
    for one in ThreadpoolController().select(user_api='blas').lib_controllers:
        one.set_num_threads(3)
        getattr(one, 'clear_controlling_thread', lambda: None)()
    known = numbers()
    with one_blas_thread:
        import scipy.linalg.lapack
        inside = numbers()
    assert inside == dict.fromkeys(known, 1), (known, inside)
    assert numbers() == known
    assert set(known.values()) == {3}
'''], capture_output=True, text=True, check=False, timeout=60,
        env=os.environ | {'OPENBLAS_NUM_THREADS': '3'})
    assert not done.returncode, done.stderr


def test_an_error_restores_the_setting():
    with pytest.raises(ZeroDivisionError):
        with one_blas_thread:
            raise ZeroDivisionError
    assert set(numbers()) == {3}


def test_the_last_of_several_callers_restores_the_setting():
    inside, leave = threading.Event(), threading.Event()

    def other_caller():
        with one_blas_thread:
            inside.set()
            leave.wait(TIMEOUT_S)

    thread = threading.Thread(target=other_caller)
    with one_blas_thread:
        thread.start()
        assert inside.wait(TIMEOUT_S)
    assert set(numbers()) == {1}
    leave.set()
    thread.join(TIMEOUT_S)
    assert set(numbers()) == {3}


def test_a_library_with_a_setting_for_each_thread_is_limited_in_the_calling_one():
    class Library:
        """Stands for a BLAS on OpenMP."""

        def __init__(self):
            self._own = threading.local()

        def get_num_threads(self):
            return getattr(self._own, 'number', 3)

        def set_num_threads(self, number):
            self._own.number = number

    library = Library()

    class Limit(type(one_blas_thread)):
        def find_libraries(self):
            self._per_thread = [library]

    limit, elsewhere = Limit(), []
    with limit, limit:
        assert library.get_num_threads() == 1
        thread = threading.Thread(target=lambda: elsewhere.append(library.get_num_threads()))
        thread.start()
        thread.join(TIMEOUT_S)
    assert elsewhere == [3]
    assert library.get_num_threads() == 3


def test_a_setting_made_in_between_remains():
    with one_blas_thread:
        allow(2)
    assert set(numbers()) == {2}


@pytest.mark.skipif(not hasattr(os, 'fork'), reason='this system has no fork')
@pytest.mark.filterwarnings('ignore:.*multi-threaded:DeprecationWarning')
def test_a_forked_process_begins_with_the_setting_of_the_process():
    with one_blas_thread:
        child = os.fork()
        if child == 0:
            os._exit(int(set(numbers()) != {3}))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert set(numbers()) == {3}


@pytest.mark.skipif(not hasattr(os, 'fork'), reason='this system has no fork')
@pytest.mark.filterwarnings('ignore:.*multi-threaded:DeprecationWarning')
def test_a_process_forked_in_a_block_can_leave_it():
    parent, code = os.getpid(), 1
    try:
        with one_blas_thread:
            child = os.fork()
        code = int(set(numbers()) != {3})
    finally:
        if os.getpid() != parent:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.fixture
def cores(request, monkeypatch):
    """Let the process use two cores, or another number that is a parameter."""
    monkeypatch.setattr(threads, '_n_cores', lambda: getattr(request, 'param', 2))


@pytest.mark.usefixtures('cores')
def test_blocks_run_side_by_side_with_one_blas_thread_each():
    # Neither block returns before both have begun.
    barrier = threading.Barrier(2)

    def block(number):
        barrier.wait(TIMEOUT_S)
        return number, set(numbers())

    assert map_blocks(block, [1, 2]) == [(1, {1}), (2, {1})]


@pytest.mark.parametrize(('limit', 'cores'), [(1, 4), (3, 1)], indirect=['cores'])
def test_blocks_use_no_more_threads_than_blas_may_or_cores_exist(limit, cores):
    with threadpool_limits(limit, user_api='blas'):
        assert map_blocks(lambda _: threading.get_ident(), [1, 2, 3]) == [
            threading.get_ident()] * 3


@pytest.mark.usefixtures('cores')
def test_blocks_start_no_threads_of_their_own():
    def outer(_):
        inner = map_blocks(lambda _: threading.get_ident(), [1, 2])
        return {threading.get_ident(), *inner}

    assert [len(identifiers) for identifiers in map_blocks(outer, [1, 2])] == [1, 1]


@pytest.mark.usefixtures('cores')
def test_an_error_in_a_block_propagates():
    with pytest.raises(ZeroDivisionError):
        map_blocks(lambda number: 1 / number, [1, 0])
    assert set(numbers()) == {3}


CODE = '''
import resource
import sys

import numpy as np

from rhs_isac_ros.support.threads import keep_memory


def faults():
    """Return the number of page faults of computations with arrays of 1 MB."""
    x, before = np.ones(1 << 17), resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        x = np.sqrt(x * x + 1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


print(faults())
keep_memory()
faults()
print(faults())
'''


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='a setting of glibc')
def test_a_worker_keeps_the_memory_of_arrays_that_are_freed():
    # As the nanny of a worker sets it; the settings of scripts/test would have priority.
    environment = os.environ | {'MALLOC_TRIM_THRESHOLD_': '65536', 'GLIBC_TUNABLES': ''}
    before, after = map(int, subprocess.check_output(
        [sys.executable, '-c', CODE], env=environment, text=True, timeout=60).split())
    assert before > 10_000
    assert after < 100
