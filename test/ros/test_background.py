"""Jobs in a background thread, results in the thread that spins."""

import threading

import pytest
from rclpy.node import Node

from rhs_isac_ros.ros.endpoints import BackgroundWorker


@pytest.fixture
def background(each_bench):
    background = BackgroundWorker(each_bench.add(Node, 'busy'))
    yield background
    background.close()


def test_a_job_runs_in_another_thread_and_its_result_is_delivered_here(each_bench, background):
    seen = []
    background.run(threading.current_thread, lambda worker: seen.append(
        (worker, threading.current_thread())))
    ((worker, receiver),) = each_bench.until(lambda: seen)
    assert receiver is threading.current_thread()
    assert worker is not receiver
    assert worker.name.startswith('busy')


def test_callbacks_continue_while_a_job_runs(each_bench, background):
    node = each_bench.add(Node, 'other')
    released, calls, results = threading.Event(), [], []
    background.run(released.wait, results.append)
    node.create_timer(0.001, lambda: calls.append(1))
    each_bench.until(lambda: len(calls) >= 3)
    assert not results
    released.set()
    each_bench.until(lambda: results == [True])


def test_jobs_run_one_after_the_other(each_bench, background):
    order = []
    for n in range(5):
        background.run(lambda n=n: order.append(('begin', n)) or n,
                       lambda n: order.append(('end', n)))
    each_bench.until(lambda: len(order) == 10)
    assert [n for kind, n in order if kind == 'begin'] == list(range(5))
    assert [n for kind, n in order if kind == 'end'] == list(range(5))


def test_an_exception_of_a_job_is_raised_where_the_node_spins(each_bench, background):
    def fail():
        raise ZeroDivisionError('of the job')
    background.run(fail, lambda result: None)
    with pytest.raises(ZeroDivisionError, match='of the job'):
        each_bench.until(lambda: False)


def test_closing_waits_for_the_running_job_and_discards_the_others(each_bench, background):
    begun, released, done, results = threading.Event(), threading.Event(), [], []

    def first():
        begun.set()
        released.wait()
        done.append(1)
    background.run(first, results.append)
    background.run(lambda: done.append(2), results.append)
    assert begun.wait(10)
    threading.Timer(0.01, released.set).start()
    background.close()
    assert done == [1]
    assert not results
