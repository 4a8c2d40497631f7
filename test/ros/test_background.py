"""Work in another thread, results in the thread that spins."""

import threading

import pytest
from rclpy.node import Node

from rhs_isac_ros.ros.background import Background


@pytest.fixture
def background(each_bench):
    background = Background(each_bench.add(Node, 'busy'))
    yield background
    background.close()


def test_work_is_done_in_another_thread_and_its_result_comes_back(each_bench, background):
    seen = []
    background.run(threading.current_thread, lambda worker: seen.append(
        (worker, threading.current_thread())))
    ((worker, receiver),) = each_bench.until(lambda: seen)
    assert receiver is threading.current_thread()
    assert worker is not receiver
    assert worker.name.startswith('busy')


def test_callbacks_go_on_while_work_is_done(each_bench, background):
    node = each_bench.add(Node, 'other')
    free, rings, results = threading.Event(), [], []
    background.run(free.wait, results.append)
    node.create_timer(0.001, lambda: rings.append(1))
    each_bench.until(lambda: len(rings) >= 3)
    assert not results
    free.set()
    each_bench.until(lambda: results == [True])


def test_one_piece_of_work_after_the_other(each_bench, background):
    order = []
    for n in range(5):
        background.run(lambda n=n: order.append(('begin', n)) or n,
                       lambda n: order.append(('end', n)))
    each_bench.until(lambda: len(order) == 10)
    assert [n for kind, n in order if kind == 'begin'] == list(range(5))
    assert [n for kind, n in order if kind == 'end'] == list(range(5))


def test_what_the_work_raises_is_raised_where_the_node_spins(each_bench, background):
    def fail():
        raise ZeroDivisionError('of the work')
    background.run(fail, lambda result: None)
    with pytest.raises(ZeroDivisionError, match='of the work'):
        each_bench.until(lambda: False)


def test_closing_waits_for_what_has_begun_and_forgets_the_rest(each_bench, background):
    begun, free, done, results = threading.Event(), threading.Event(), [], []

    def first():
        begun.set()
        free.wait()
        done.append(1)
    background.run(first, results.append)
    background.run(lambda: done.append(2), results.append)
    assert begun.wait(10)
    threading.Timer(0.01, free.set).start()
    background.close()
    assert done == [1]
    assert not results
