"""The guarantees of the protocol hold under losses, duplicates, delays, crashes and restarts."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example as explicit
from hypothesis import given
from hypothesis import strategies as st
from in_memory_network import Fault, Network, Noisy, faults, on_time

from rhs_isac_ros.model import mobility
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState

STEP_S, ACK_S, REST_S = 0.2, 0.05, 0.08
# Duration of the faults, and the time within which every user must be served after it.
FAULTS_END_S, RECOVERY_S = 1.0, 3.0
ROLES = ('bs', 'rhs_controller', 'channel', 'positioner', 'transmission', 'user1', 'user2')
LOST = [(kind, recipient) for recipient, kinds in {
    'bs': (m.Ack, m.RhsConfiguration, m.FeedSignals, m.PositionEstimate, m.Beam, m.Data),
    'user1': (m.Beacon, m.Grant, m.PilotRequest, m.Data),
    'user2': (m.Beacon, m.Grant, m.PilotRequest, m.Data),
    'rhs_controller': (m.Grant, m.RhsCommand, m.Beam),
    'channel': (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data),
    'positioner': (m.ReceivedSignals,),
    'transmission': (m.PositionEstimate, m.RhsConfiguration, m.GroundTruth),
}.items() for kind in kinds]


class Crash(NamedTuple):
    """A role crashes, detected by its peers or not, and restarts."""

    at_s: float
    role: str
    down_s: float
    noticed: bool


class Offer(NamedTuple):
    """A codebook is offered to all roles that are present."""

    at_s: float
    number: int


class Change(NamedTuple):
    """New settings are offered to a role, if it is present."""

    at_s: float
    role: str
    values: dict


TIMES_S = st.sampled_from([n * FAULTS_END_S / 30 for n in range(30)]) | st.floats(
    0, FAULTS_END_S, allow_subnormal=False)
DELAYS_S = st.sampled_from([1e-3, 2.5e-3, 0.03, 0.08, 0.25, 0.45])
# Pairs of a class and a recipient, number of messages before the fault, and its delays.
FAULTS = st.lists(st.tuples(
    st.sampled_from(LOST), st.integers(0, 12), st.lists(DELAYS_S, max_size=2)), max_size=8)
CRASHES = st.lists(st.builds(
    Crash, TIMES_S, st.sampled_from(ROLES), st.sampled_from([0.0, 0.01, 0.1, 0.4]),
    st.booleans()), max_size=4)
RETRIES = st.sampled_from([0, 3])
OFFERS = st.lists(st.builds(Offer, TIMES_S, st.integers(0, 2)), max_size=2)
CHANGES = st.lists(st.builds(Change, TIMES_S, st.just('bs'), st.sampled_from([
    {'policy': 'first'}, {'policy': 'random'}, {'receiver_noise': False}, {'retries': 2},
    {'rest_s': 0.0}])) | st.builds(Change, TIMES_S, st.just('positioner'), st.sampled_from([
        {'estimator': 'ml'}, {'estimator': 'bayes'},
        {'estimator': 'neural', 'model_file': 'unfit'}])), max_size=4)
NOISE = st.fixed_dictionaries({
    'seed': st.integers(0, 2**32 - 1), 'loss': st.sampled_from([0.0, 0.02, 0.1]),
    'doubles': st.sampled_from([0.0, 0.1, 0.5]),
    'jitter_s': st.sampled_from([0.0, 0.01, 0.1, 0.5])})


@pytest.fixture(scope='module')
def make_network(scenario, codebooks):
    """Function that returns a network of two fast users."""
    def make(transport, ordered, retries):
        users = {user: mobility.RandomWalk(scenario, 50.0, np.random.default_rng(user))
                 for user in (1, 2)}
        return Network(
            scenario, codebooks[0], users, transport=transport, ordered=ordered,
            step_timeout_s=STEP_S, ack_timeout_s=ACK_S, rest_s=REST_S, retries=retries)
    return make


@pytest.fixture(scope='module')
def run_and_check(codebooks):
    """Function that runs a network through crashes, offers and changes and checks its recovery."""
    def run(net, crashes, offers, changes):
        events = [(crash.at_s, lambda crash=crash: stop(net, crash)) for crash in crashes]
        events += [(crash.at_s + crash.down_s, lambda crash=crash: start(net, crash.role))
                   for crash in crashes]
        events += [(offer.at_s, lambda offer=offer: net.offer(codebooks[offer.number]))
                   for offer in offers]
        events += [(change.at_s, lambda change=change: change_settings(net, change))
                   for change in changes]
        for at_s, act in sorted(events, key=lambda pair: pair[0]):
            net.run(limit_s=at_s - net.now_s)
            act()
        net.run(limit_s=max(FAULTS_END_S - net.now_s, 0.0))
        net.transport = on_time
        # Other policies do not guarantee service to every user.
        net.change('bs', policy='round_robin')
        check_end(net)
        net.verify()
        # One true position in each cycle.
        places = {(truth.cycle_id, *truth.position) for truth in net.sent(m.GroundTruth)}
        assert len(places) == len({cycle_id for cycle_id, *_ in places})
        # The model file of this estimator does not fit.
        assert not net.sent(m.PositionEstimate, estimator='neural')
    return run


def stop(net, crash):
    if crash.role in net:
        net.remove(crash.role, crash.noticed)


def start(net, role):
    if role not in net:
        net.add(role)


def change_settings(net, change):
    if change.role in net:
        net.change(change.role, **change.values)


def check_end(net):
    """Check that the base station sends beacons again and serves every user."""
    net.run_to(BsState.BEACONING, limit_s=RECOVERY_S)
    before = len(net.served())
    net.run(lambda: {1, 2} <= set(net.served()[before:]), RECOVERY_S)
    net.run_to(BsState.BEACONING, limit_s=RECOVERY_S)


@given(affected=FAULTS, crashes=CRASHES, offers=OFFERS, changes=CHANGES, ordered=st.booleans(),
       retries=RETRIES)
@explicit(affected=[], crashes=[], offers=[], changes=[], ordered=True, retries=3)
def test_guarantees_hold_under_single_faults_and_crashes(
        make_network, run_and_check, affected, crashes, offers, changes, ordered, retries):
    transport = faults(*(Fault(*pair, *delays_s, n=1, skip=skip)
                         for pair, skip, delays_s in affected))
    run_and_check(make_network(transport, ordered, retries), crashes, offers, changes)


@given(noise=NOISE, crashes=CRASHES, offers=OFFERS, changes=CHANGES, ordered=st.booleans(),
       retries=RETRIES)
# A late beacon and a late grant of a finished cycle.
@explicit(noise={'seed': 1038635, 'loss': 0.02, 'doubles': 0.5, 'jitter_s': 0.5},
          crashes=[Crash(0.0, 'rhs_controller', 0.0, False), Crash(0.0, 'channel', 0.0, False)],
          offers=[], changes=[], ordered=False, retries=0)
def test_guarantees_hold_under_random_faults_and_crashes(
        make_network, run_and_check, noise, crashes, offers, changes, ordered, retries):
    run_and_check(make_network(Noisy(**noise), ordered, retries), crashes, offers, changes)
