"""Running jobs: stored results, repeated jobs, and runs that end early."""

import functools
import importlib
import io
import json
import os
import queue
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from rhs_isac_ros.experiments import Job, JobError, run_jobs
from rhs_isac_ros.support import jobs as jobs_module
from rhs_isac_ros.support import sources
from rhs_isac_ros.support.jobs import Workers
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.support.plugins import ESTIMATORS, load

pytestmark = pytest.mark.slow

JOBS = [Job(f'square-{number}', {'number': number, 'of': (1, 2)}) for number in range(4)]
# joblib's tracker of semaphores finds one that the program has removed, but still registers.
LEAKY = '''
from rhs_isac_ros.experiments import Job, run_jobs

run_jobs(lambda n: {'n': n}, [Job('a', {'n': 1})], n_jobs=2)
from joblib.externals.loky.backend import resource_tracker
resource_tracker.register('/rhs-isac-removed', 'semlock')
'''
# A worker sends SIGINT to the process group, as a terminal does on Ctrl-C, then waits.
INTERRUPTED = '''
import os, signal, sys
from pathlib import Path
from rhs_isac_ros.experiments import Job, run_command, run_jobs

# As in a terminal: a shell starts background jobs, and so perhaps the tests, with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)

def work(number):
    if number == 2:
        os.killpg(0, signal.SIGINT)
        signal.pause()
    return {'number': number}

jobs = [Job(str(number), {'number': number}) for number in range(4)]
sys.exit(run_command(lambda: run_jobs(work, jobs, Path(sys.argv[1]), n_jobs=2)))
'''


# A job waits far longer than the test, in a process of this machine or on a cluster.
ABANDONED = '''
import os, sys, time
from pathlib import Path
from rhs_isac_ros.experiments import Job, run_jobs

def work(begun):
    Path(begun).write_text(str(os.getpid()))
    for _ in range(6000):
        time.sleep(0.1)

jobs = [Job(name, {'begun': sys.argv[1] + name}) for name in 'ab']
run_jobs(work, jobs, **({'dask': sys.argv[2]} if len(sys.argv) > 2 else {'n_jobs': 2}))
'''

# A scheduler with one worker, in one process.
SCHEDULER = '''
import signal

from distributed import LocalCluster

if __name__ == '__main__':
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, processes=False, protocol='tcp',
                           host='127.0.0.1', dashboard_address=':0')
    print(cluster.scheduler_address, flush=True)
    signal.pause()
'''


class Worker:
    """Squares numbers in this process and records them; fails at a given one."""

    def __init__(self, fails_at=None, error=None):
        self.seen, self._fails_at, self._error = [], fails_at, error

    def __repr__(self):
        """Return a text without the record, which is no source of a result."""
        return 'a worker'

    def __call__(self, number, of):
        if number == self._fails_at:
            raise self._error
        self.seen.append(number)
        return {'square': number**2}


def numbers_run_again(folder, jobs=JOBS):
    worker = Worker()
    assert run_jobs(worker, jobs, folder, n_jobs=1) == [
        {'square': job.arguments['number']**2} for job in jobs]
    return worker.seen


def test_other_processes_with_one_thread_take_one_job_at_a_time(tmp_path):
    def meet(number):
        """Wait for the other job of a pair, which needs another process."""
        import os
        (tmp_path / f'here-{number}').touch()
        deadline = time.monotonic() + 60
        while not (tmp_path / f'here-{number ^ 1}').exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        return {'process': os.getpid(), 'threads': os.environ['OPENBLAS_NUM_THREADS']}

    jobs = [Job(str(number), {'number': number}) for number in range(8)]
    results = run_jobs(meet, jobs, tmp_path, n_jobs=2)
    assert len({os.getpid(), *(result['process'] for result in results)}) == 3
    assert {result['threads'] for result in results} == {'1'}


def test_an_interrupted_run_keeps_its_finished_jobs(tmp_path):
    worker = Worker(2, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_jobs(worker, JOBS, tmp_path, n_jobs=1)
    assert worker.seen == [0, 1]
    assert numbers_run_again(tmp_path) == [2, 3]
    assert numbers_run_again(tmp_path) == []


@pytest.mark.parametrize('content', [
    b'', b'{"sources": ', b'\xff\xfe', b'[]', b'{}', b'{"result": 1}', {'sources': '0.0.0'},
    {'arguments': {'number': 1, 'of': [1, 3]}}])
def test_a_job_whose_result_is_damaged_or_of_another_call_is_repeated(tmp_path, content):
    run_jobs(Worker(), JOBS, tmp_path, n_jobs=1)
    file = tmp_path / 'square-1.json'
    file.write_bytes(content if isinstance(content, bytes) else json.dumps(
        json.loads(file.read_text()) | content).encode())
    assert numbers_run_again(tmp_path) == [1]
    assert numbers_run_again(tmp_path) == []


def test_a_worker_with_other_sources_is_an_error(tmp_path, monkeypatch):
    answers = iter(['ours', 'theirs', 'ours', 'ours'])
    monkeypatch.setattr(jobs_module, 'sources_of', lambda *_: next(answers))
    with pytest.raises(JobError, match='square-0: the worker has .* theirs, expected ours'):
        run_jobs(Worker(), JOBS, n_jobs=1)


@pytest.mark.parametrize('wrap', [lambda work: work, functools.partial])
def test_results_of_other_sources_are_not_reused(tmp_path, monkeypatch, wrap):
    """Sources are those of the package, of the function, and of what its module imports."""
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / 'study.py').write_text(
        'from helper import found\n'
        'calls = []\n'
        'def work(number, of):\n'
        '    calls.append(number)\n'
        '    return {"found": found()}\n')
    found = []
    for text in ('1', '1', '2'):
        (tmp_path / 'helper.py').write_text(f'def found():\n    return {text}\n')
        for name in ('helper', 'study'):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        sources._digest.cache_clear()
        study = importlib.import_module('study')
        found += run_jobs(wrap(study.work), JOBS[:1], tmp_path / 'kept', n_jobs=1)
        found += study.calls
    assert found == [{'found': 1}, 0, {'found': 1}, {'found': 2}, 0]


def test_a_plugin_that_an_argument_names_is_a_source(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)
    monkeypatch.syspath_prepend(tmp_path)

    def work(estimator):
        return {'n': load(ESTIMATORS, estimator)().n()}
    found = []
    for text in ('1', '2'):
        (tmp_path / 'my_lab.py').write_text(f'class Grid:\n    def n(self): return {text}\n')
        monkeypatch.delitem(sys.modules, 'my_lab', raising=False)
        importlib.invalidate_caches()
        load(ESTIMATORS, 'my_lab:Grid')
        found += run_jobs(
            work, [Job('a', {'estimator': 'my_lab:Grid'})], tmp_path / 'kept', n_jobs=1)
    assert found == [{'n': 1}, {'n': 2}]


@pytest.mark.parametrize('text', [
    'class Grid:\n    def n(self): return {}\n',
    'N = n_calls = {}\nM: float = 1.5\nclass Grid:\n    def n(self): return N\n'])
def test_a_worker_with_a_module_from_before_an_edit_is_an_error(tmp_path, monkeypatch, text):
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)
    monkeypatch.syspath_prepend(tmp_path)
    digests, ends = [], []
    for number in (1, 2):
        (tmp_path / 'old_lab.py').write_text(text.format(number))
        monkeypatch.delitem(sys.modules, 'old_lab', raising=False)
        importlib.invalidate_caches()
        digests.append(sources.code_of(importlib.import_module('old_lab')))
        ends += [jobs_module.attempt(
            lambda: {'n': load(ESTIMATORS, 'old_lab:Grid')().n()}, Job('a', {}),
            modules={'old_lab': digest}) for digest in digests]
    assert [bool(end.error) for end in ends] == [False, True, False]
    assert ends[1].error == (
        'the worker has another version of the module old_lab; restart the workers')


@pytest.mark.parametrize('name', ['', 'a/b', '../a', '/a'])
def test_a_name_that_is_no_file_name_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match=f'job {name!r}: expected the name of a file'):
        run_jobs(Worker(), [Job(name, {'number': 1, 'of': 1})], tmp_path / 'kept', n_jobs=1)


def test_a_result_is_a_mapping_and_a_process_is_needed(tmp_path):
    with pytest.raises(JobError, match='TypeError: 1, expected a mapping'):
        run_jobs(lambda number, of: 1, JOBS[:1], str(tmp_path), n_jobs=1)
    with pytest.raises(ValueError, match='n_jobs: 0, expected 1 or more'):
        run_jobs(Worker(), JOBS, n_jobs=0)


def test_what_cannot_be_sent_to_a_cluster_is_named(cluster):
    lock = threading.Lock()

    def work(number, of):
        return {'lock': str(lock)}

    with pytest.raises(JobError, match="(?s)^job square-0 failed: .* pickle '_thread.lock'"):
        run_jobs(work, JOBS[:2], dask=cluster.scheduler_address)


def test_what_a_process_cannot_read_is_named():
    class Unreadable:
        def __reduce__(self):
            return int, ('nothing',)

    unreadable = Unreadable()
    with pytest.raises(JobError, match="^job square-. failed: .* literal .*'nothing'$"):
        run_jobs(lambda number, of: {'it': str(unreadable)}, JOBS[:2], n_jobs=2)


def test_a_result_may_be_infinite_or_missing(tmp_path):
    calls = []
    # A list that a function refers to is a source of its results; a method is not.
    record = calls.append

    def work(number, of):
        record(number)
        return {'mean': float('inf'), 'low': float('nan')}

    for _ in range(2):
        (result,) = run_jobs(work, JOBS[:1], tmp_path, n_jobs=1)
        assert result['mean'] == float('inf') and result['low'] != result['low']
    assert calls == [0]


def test_values_of_numpy_are_numbers_and_lists(tmp_path):
    given = {'number': np.int64(3), 'of': (np.float32(0.5), np.arange(2), {'a': np.bool_(True)})}
    seen = []
    record = seen.append

    def work(number, of):
        record((number, of))
        return {'square': np.float32(number**2), 'each': np.eye(2)}

    for _ in range(2):
        assert run_jobs(work, [Job('numpy', given)], tmp_path, n_jobs=1) == [
            {'square': 9.0, 'each': [[1.0, 0.0], [0.0, 1.0]]}]
    assert seen == [(3, (0.5, [0, 1], {'a': True}))]
    assert type(seen[0][0]) is int


def test_an_argument_without_json_is_refused_before_any_job_runs(tmp_path):
    worker = Worker()
    for value, text in (({1}, r'\{1\}, expected numbers'),
                        ([{1: 2}], r'\[\{1: 2\}\].*key 1, expected texts')):
        with pytest.raises(ValueError, match=rf'^job b: of: {text}'):
            run_jobs(worker, [JOBS[0], Job('b', {'number': 1, 'of': value})], tmp_path, n_jobs=1)
    assert worker.seen == []


def test_equal_arguments_of_other_types_are_other_jobs(tmp_path):
    def work(value):
        return {'type': type(value).__name__}

    for value in (1, 1.0, True, float('nan'), 1):
        (result,) = run_jobs(work, [Job('one', {'value': value})], tmp_path, n_jobs=1)
        assert result == {'type': type(value).__name__}


@pytest.mark.parametrize(('failure', 'text', 'n_jobs'), [
    (lambda: ().index(0), 'Traceback .*ValueError: ', 1),
    (lambda: ().index(0), 'Traceback .*ValueError: ', 2),
    (lambda: {'square': {1, 2}}, 'Traceback .*not JSON serializable', 1),
    # In one line.
    (lambda: (_ for _ in ()).throw(MissingLibraryError('needs pymoo')), 'needs pymoo$', 1)])
def test_an_error_names_its_job_and_other_results_are_kept(tmp_path, failure, text, n_jobs):
    def work(number, of):
        return {'square': number**2} if number != 2 else failure()

    with pytest.raises(JobError, match=f'(?s)^job square-2 failed: {text}'):
        run_jobs(work, JOBS[:3], tmp_path, n_jobs=n_jobs)
    assert numbers_run_again(tmp_path, JOBS[:3])[-1] == 2


def test_a_strand_continues_as_soon_as_its_own_jobs_are_done():
    order = []

    def work(name):
        order.append(name)
        return {'name': name}

    def strand(name, n_stages):
        found = []
        for stage in range(n_stages):
            found += yield work, [Job(f'{name}{stage}', {'name': f'{name}{stage}'})]
        return [one['name'] for one in found]

    ends = Workers().run([strand('a', 3), strand('b', 1), strand('a', 2), strand('c', 0)])
    # Two strands share the first jobs, which run once.
    assert ends == [['a0', 'a1', 'a2'], ['b0'], ['a0', 'a1'], []]
    assert order == ['a0', 'b0', 'a1', 'a2']


def test_jobs_of_one_name_with_other_arguments_are_an_error():
    def strand(value):
        yield (lambda value: {}), [Job('one', {'value': value})]

    with pytest.raises(ValueError, match='^jobs: two have the name one'):
        Workers().run([strand(1), strand(1.0)])


def abandon(arguments, folder):
    """Kill a client once its two jobs have begun, and wait for its processes to end.

    Returns the ids of the processes of the jobs.
    """
    with subprocess.Popen([sys.executable, '-c', ABANDONED, f'{folder}/', *arguments],
                          stderr=subprocess.PIPE, start_new_session=True) as client:
        deadline = time.monotonic() + 60
        while not all((folder / name).exists() and (folder / name).read_text() for name in 'ab'):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        client.kill()
        # The pipe ends with the last process that has inherited it.
        client.communicate(timeout=240)
    return [int((folder / name).read_text()) for name in 'ab']


def test_jobs_of_a_killed_client_end(tmp_path):
    assert len({*abandon([], tmp_path)}) == 2


def test_a_process_that_dies_is_an_error(tmp_path):
    def work(number, of):
        import os
        os._exit(3)

    with pytest.raises(JobError, match='a process died'):
        run_jobs(work, JOBS, tmp_path, n_jobs=2)


def test_warnings_of_removed_semaphores_do_not_follow_the_end_of_a_program():
    # The call returns only after the tracker, which inherits the pipe, has ended.
    done = subprocess.run(
        [sys.executable, '-c', LEAKY], capture_output=True, text=True, timeout=240, check=True)
    assert 'resource_tracker' not in done.stderr


def test_a_run_that_ends_as_a_job_is_sent_shows_no_traceback(monkeypatch):
    """joblib 1.6.0: processes that are killed before a call is seen end its thread."""
    class Queue(queue.SimpleQueue):
        n_left = 2

        def get(self):
            self.n_left -= 1
            if not self.n_left:
                raise KeyboardInterrupt
            return super().get()

    failed = []
    monkeypatch.setattr(threading, 'excepthook', failed.append)
    monkeypatch.setattr(jobs_module.queue, 'SimpleQueue', Queue)
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            run_jobs(lambda number, of: {'square': number**2}, JOBS, n_jobs=2)
    assert not failed


def test_ctrl_c_ends_all_processes_and_the_run_resumes(tmp_path):
    # The call returns only after every process that inherited the pipes has ended.
    done = subprocess.run(
        [sys.executable, '-c', INTERRUPTED, str(tmp_path)], capture_output=True, text=True,
        timeout=240, start_new_session=True, check=False)
    assert done.returncode == 130, done.stderr
    assert done.stderr == 'interrupted: finished jobs are kept; repeat the command to resume\n'
    jobs = [Job(str(number), {'number': number}) for number in range(4)]
    results = run_jobs(lambda number: {'number': number}, jobs, tmp_path, n_jobs=1)
    assert [result['number'] for result in results] == [0, 1, 2, 3]


@pytest.fixture(scope='module')
def cluster():
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=':0') as local:
        yield local


def test_jobs_run_on_a_dask_cluster(tmp_path, cluster):
    def work(number, of):
        from distributed import get_worker
        return {'square': number**2, 'worker': get_worker().address}

    results = run_jobs(work, JOBS, tmp_path, dask=cluster.scheduler_address)
    assert [result['square'] for result in results] == [0, 1, 4, 9]
    assert {result['worker'] for result in results} == {cluster.workers[0].address}
    with pytest.raises(JobError, match='(?s)job square-1 failed: .*ValueError: no good'):
        run_jobs(Worker(1, ValueError('no good')), JOBS[:2], tmp_path / 'other',
                 dask=cluster.scheduler_address)


@pytest.fixture
def two_workers(tmp_path):
    """Address of a scheduler with two workers, processes that it does not restart."""
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(
            n_workers=0, protocol='tcp', host='127.0.0.1', dashboard_address=':0') as empty:
        workers = [subprocess.Popen(
            [sys.executable, '-m', 'distributed.cli.dask_worker', empty.scheduler_address,
             '--no-nanny', '--nthreads', '1', '--no-dashboard', '--local-directory',
             str(tmp_path)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=os.environ | {'OPENBLAS_NUM_THREADS': '1'}) for _ in range(2)]
        try:
            with distributed.Client(empty, set_as_default=False) as client:
                client.wait_for_workers(2, timeout=240)
            yield empty.scheduler_address
        finally:
            for worker in workers:
                worker.kill()
            for worker in workers:
                worker.wait()


def test_a_cluster_that_loses_a_worker_gives_every_result(tmp_path, two_workers):
    def work(number, killed):
        import os
        import signal
        from pathlib import Path
        if number == 3 and not Path(killed).exists():
            Path(killed).write_text(str(os.getpid()), encoding='ascii')
            os.kill(os.getpid(), signal.SIGKILL)
        return {'square': number**2, 'process': os.getpid()}

    killed = tmp_path / 'killed'
    jobs = [Job(str(number), {'number': number, 'killed': str(killed)}) for number in range(8)]
    results = run_jobs(work, jobs, tmp_path / 'results', dask=two_workers)
    assert [result['square'] for result in results] == [number**2 for number in range(8)]
    assert results[3]['process'] != int(killed.read_text(encoding='ascii'))


def test_a_cluster_ends_the_jobs_of_a_killed_client(tmp_path, two_workers):
    def work(number):
        import os
        return {'process': os.getpid()}

    occupied = abandon([two_workers], tmp_path)
    # The workers are free again.
    results = run_jobs(work, [Job(str(n), {'number': n}) for n in range(8)], dask=two_workers)
    assert {result['process'] for result in results} <= {*occupied}


def test_a_scheduler_that_ends_is_an_error_and_finished_jobs_are_kept(tmp_path):
    pytest.importorskip('distributed')

    def work(number, scheduler, stored):
        import os
        import signal
        import time
        from pathlib import Path
        if number:
            while not Path(stored).exists():
                time.sleep(0.01)
            os.kill(scheduler, signal.SIGKILL)
            signal.pause()
        return {'number': number}

    scheduler = subprocess.Popen(
        [sys.executable, '-c', SCHEDULER], stdout=subprocess.PIPE, text=True)
    try:
        address = scheduler.stdout.readline().strip()
        jobs = [Job(str(n), {'number': n, 'scheduler': scheduler.pid,
                             'stored': str(tmp_path / '0.json')}) for n in range(2)]
        with pytest.raises(ConnectionError, match='connection lost'):
            run_jobs(work, jobs, tmp_path, dask=address)
    finally:
        scheduler.kill()
        scheduler.wait()
        scheduler.stdout.close()
    assert [file.name for file in tmp_path.iterdir()] == ['0.json']


def test_a_dask_cluster_without_workers_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr('rhs_isac_ros.support.jobs._WORKER_TIMEOUT_S', 0.1)
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=':0') as empty:
        with pytest.raises(ConnectionError, match='^Dask cluster inproc://.*workers'):
            run_jobs(Worker(), JOBS, tmp_path, dask=empty.scheduler_address)


def test_a_terminal_shows_the_progress(tmp_path, monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, 'stderr', terminal)
    pytest.importorskip('tqdm')
    run_jobs(Worker(), JOBS, tmp_path, n_jobs=1)
    assert '100%' in terminal.getvalue()


def test_duplicate_names_are_an_error(tmp_path):
    with pytest.raises(ValueError, match='two have the same name'):
        run_jobs(Worker(), [JOBS[0], JOBS[0]], tmp_path, n_jobs=1)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'joblib', None)
    with pytest.raises(MissingLibraryError, match='^running jobs needs joblib, .*experiments'):
        run_jobs(Worker(), JOBS, tmp_path, n_jobs=2)
