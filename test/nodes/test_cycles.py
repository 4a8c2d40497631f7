"""Cycles of a network of processes: their messages, their users and recovery from faults."""

import math
import signal
import types

import pytest
from node_processes import messages_of_cycle

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.messages import check

SCENARIO = Scenario()
COMPLETE = messages_of_cycle(SCENARIO.sizes['N_B'])
# Also on a busy machine, a step is repeated only if a message is lost. A cycle without its user
# ends soon.
STEPS = {'step_timeout_s': 4.0, 'retries': 1}
# Parameters of the nodes, in another order than in test_start_and_stop.
BASE = {'channel': {}, 'transmission': {}, 'positioner': {}, 'optimizer': {}, 'rhs_controller': {},
        'bs': {'rest_s': 0.1, 'ack_timeout_s': 0.3, **STEPS}}


@pytest.fixture(scope='module')
def network(module_processes, make_watch):
    """A network without users, in the scenario of the paper."""
    running = {name: module_processes.start(name, **values) for name, values in BASE.items()}
    watch = make_watch()
    watch.until(lambda: watch.received[m.Beacon], 'the first beacon', running.values())
    return types.SimpleNamespace(watch=watch, running=running)


@pytest.fixture
def join(network, processes):
    """Yield a function that starts a user, which ends with the test."""
    yield lambda user: processes.start(
        'user', name=f'user_{user}', user_id=user, step_timeout_s=STEPS['step_timeout_s'])
    for process in network.running.values():
        assert process.running, process.log


def beacons_in_a_row(watch, since):
    """Return whether the last four of the beacons since an index belong to one cycle."""
    cycle_ids = [beacon.cycle_id for beacon in watch.received[m.Beacon][since:][-4:]]
    return len(cycle_ids) == 4 and len(set(cycle_ids)) == 1


def is_complete(watch, cycle_id):
    """Return whether the observer and the transmission have received all messages of a cycle."""
    return (all(len(watch.of_cycle(kind, cycle_id)) == n for kind, n in COMPLETE.items())
            and math.isfinite(watch.of_cycle(m.Capacity, cycle_id)[0].actual_bps))


def test_all_messages_of_a_cycle_carry_its_user_and_codebook(network, join):
    codebook, watch = Codebook.default(), network.watch
    join(1)

    def complete():
        """Return complete cycles; in the first ones, some nodes lack the topics of the user."""
        return [end.cycle_id for end in watch.served[-20:] if is_complete(watch, end.cycle_id)]
    for number in watch.until(lambda: complete()[4:] and complete(), 'complete cycles'):
        everything = [message for kind in COMPLETE for message in watch.of_cycle(kind, number)]
        assert {message.user for message in everything if hasattr(message, 'user')} == {1}
        assert {message.codebook_id for message in everything
                if hasattr(message, 'codebook_id')} == {codebook.id}
        for message in everything:
            check(message, SCENARIO)


def test_a_user_that_crashes_in_its_cycle_is_served_after_its_restart(network, join):
    watch, interrupted = network.watch, None

    def crash(grant):
        nonlocal interrupted
        # A user of an earlier test may still be granted a cycle.
        if grant.user == 3:
            victim.signal(signal.SIGKILL)
            interrupted = grant.cycle_id
    # On a loaded machine, the cycle may end before the signal arrives.
    for _ in range(5):
        victim = join(3)
        watch.until_served(user=3, processes=[victim])
        watch.hooks[m.Grant] = crash
        watch.until(lambda victim=victim: not victim.running, 'the end of the user')
        assert victim.wait() == -signal.SIGKILL
        del watch.hooks[m.Grant]
        before = len(watch.received[m.Beacon])
        watch.until(lambda before=before: beacons_in_a_row(watch, before), 'repeated beacons',
                    network.running.values())
        if interrupted not in {end.cycle_id for end in watch.served}:
            break
    assert (interrupted, 3) in {(end.cycle_id, end.user) for end in watch.given_up}
    watch.until_served(2, user=3, processes=[join(3)])


@pytest.mark.parametrize('names', [
    ('bs',), ('channel', 'positioner', 'rhs_controller', 'transmission', 'optimizer')],
    ids=lambda names: '+'.join(names))
def test_cycles_continue_after_nodes_crash_and_restart(network, module_processes, join, names):
    watch, running = network.watch, network.running
    join(1)
    watch.until_served(user=1)
    for name in names:
        running[name].signal(signal.SIGKILL)
    for name in names:
        assert running[name].wait() == -signal.SIGKILL
        running[name] = module_processes.start(name, **BASE[name])
    before = len(watch.received[m.Beacon])
    watch.until(lambda: len(watch.received[m.Beacon]) > before, 'beacons', running.values())
    watch.until_served(3, user=1, processes=running.values())
    # The base station repeats no number after a restart.
    numbers = [beacon.cycle_id for beacon in watch.received[m.Beacon]]
    assert numbers == sorted(numbers)
    grants = [grant.cycle_id for grant in watch.received[m.Grant]]
    assert len(set(grants)) == len(grants)
