"""The client of the codebook that the optimizer holds."""

import dataclasses

import numpy as np
import pytest
from rclpy.node import Node
from ros_messages import parameters

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.optimizer import OptimizerNode
from rhs_isac_ros.ros.role_node import CodebookClient


@pytest.fixture
def follow(bench):
    """Return a function that creates a client and returns the list of its codebooks."""
    def follow(scenario=None, name='client', **options):
        got = []
        node = bench.add(Node, name, **options)
        CodebookClient(node, scenario or Scenario(), got.append)
        return got
    return follow


@pytest.fixture
def optimizer_of(bench, bench_files):
    """Return a function that creates an optimizer with a codebook of the small scenario."""
    def optimizer_of(name, **options):
        return bench.add(OptimizerNode, values={
            'scenario_file': bench_files / 'scenario.yaml',
            'codebook_file': bench_files / f'{name}.yaml'}, **options)
    return optimizer_of


def ids(codebooks):
    return [codebook.id for codebook in codebooks]


@pytest.fixture(scope='session')
def stored(bench_files):
    return {name: Codebook.load(bench_files / f'{name}.yaml') for name in ('first', 'second')}


def change(optimizer, codebook):
    result = optimizer.set_parameters_atomically(parameters(codebook.to_parameters()))
    assert result.successful, result.reason


def test_the_codebook_arrives_once_and_bit_for_bit(bench, follow, shipped):
    bench.add(OptimizerNode)
    got = follow()
    bench.until(lambda: got, 'the codebook')
    later = follow(name='later')
    bench.until(lambda: later, 'the codebook of the other client')
    for codebook in (*got, *later):
        assert codebook.analog.tobytes() == shipped.analog.tobytes()
        assert codebook.digital.tobytes() == shipped.digital.tobytes()
        assert codebook.average_crlb_m2 == shipped.average_crlb_m2
        assert codebook.provenance == shipped.provenance
    assert len(got) == len(later) == 1


def test_the_last_of_many_changes_is_fetched(bench, follow, optimizer_of, random_beams, small):
    optimizer = optimizer_of('first')
    got = follow(small.scenario)
    bench.until(lambda: got, 'the first codebook')
    rng = np.random.default_rng(3)
    for _ in range(10):
        last = random_beams(small.scenario, rng)
        change(optimizer, last)
    bench.until(lambda: got[-1].id == last.id, 'the last codebook')


def test_a_change_that_is_reverted_while_it_is_fetched_does_not_stay(
        bench, follow, optimizer_of, stored, small, monkeypatch):
    optimizer = optimizer_of('first')
    got = follow(small.scenario)
    bench.until(lambda: got, 'the first codebook')
    read, done = optimizer.get_parameter, []

    def revert(name):
        """Read a parameter; revert the change before the response is sent."""
        value = read(name)
        if name == 'codebook.digital_im' and not done:
            done.append(name)
            change(optimizer, stored['first'])
        return value
    change(optimizer, stored['second'])
    monkeypatch.setattr(optimizer, 'get_parameter', revert)
    bench.until(lambda: done, 'the change')
    # The request of another client was later, so pending responses have arrived.
    other = follow(small.scenario, 'other')
    bench.until(lambda: other, 'the codebook of the other client')
    bench.until(lambda: got[-1].id == stored['first'].id, 'the current codebook')
    assert ids(other) == [stored['first'].id]


def test_a_change_of_other_parameters_is_not_a_new_codebook(
        bench, follow, optimizer_of, stored, small):
    optimizer = optimizer_of('first')
    got = follow(small.scenario)
    bench.until(lambda: got, 'the first codebook')
    change(optimizer, dataclasses.replace(stored['first'], average_crlb_m2=0.5))
    # This client has sent another request by the time another client has its codebook.
    other = follow(small.scenario, 'other')
    bench.until(lambda: other, 'the first codebook of the other client')
    change(optimizer, stored['second'])
    bench.until(lambda: got[-1].id == stored['second'].id, 'the second codebook')
    assert ids(got) == [stored['first'].id, stored['second'].id]


def test_a_codebook_that_does_not_fit_is_rejected_with_one_error(
        bench, follow, optimizer_of, stored, small, random_beams, capfd):
    unsuitable = bench.add(OptimizerNode)
    got = follow(small.scenario)
    witness = follow(name='witness')
    log = []

    def has_error():
        log.append(capfd.readouterr().err)
        return 'rejected' in ''.join(log)
    bench.until(has_error, 'the error')
    text = next(line for line in ''.join(log).splitlines() if 'rejected' in line)
    assert '[ERROR]' in text
    assert 'optimizer' in text
    sizes = small.scenario.sizes
    expected = tuple(sizes[symbol] for symbol in ('N_B', 'F', 'N_E'))
    assert f'analog: shape (2, 4, 100), expected [N_B, F, N_E] = {expected}' in text
    assert not got
    bench.until(lambda: witness, 'the codebook where it fits')
    # The same error again is not logged.
    change(unsuitable, random_beams(Scenario(), np.random.default_rng(0)))
    bench.until(lambda: len(witness) == 2, 'the change')
    bench.remove(unsuitable)
    optimizer = optimizer_of('first')
    change(optimizer, stored['second'])
    bench.until(lambda: got, 'the codebook that fits')
    assert got[-1].id in {codebook.id for codebook in stored.values()}
    log.append(capfd.readouterr().err)
    assert sum('[client]' in line and 'rejected' in line
               for line in ''.join(log).splitlines()) == 1
