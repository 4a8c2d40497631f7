"""Handover of data between the surfaces of a site."""

import dataclasses
import types

import numpy as np
import pytest
from in_memory_network import SUBSCRIPTIONS, Fault, Network, faults, plain_choice

from rhs_isac_ros.link import CapacityReport
from rhs_isac_ros.model import Pose
from rhs_isac_ros.positioning import Mixture, Sighting, Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.events import Outcome
from rhs_isac_ros.protocol.fusion import Fusion, posterior_of
from rhs_isac_ros.protocol.handover import Carriers, Steering
from rhs_isac_ros.protocol.receiver import Receiver
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.protocol.settings import Impairments
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.ros.node_surface import NodeSurface
from rhs_isac_ros.ros.roster import FOLLOWING, MEMBERS
from rhs_isac_ros.system import System

POSES = {'front': Pose(), 'side': Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0)),
         'rear': Pose((20.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))}
# Places near one of the surfaces, and a place that is as near to `front` as to `side`.
NEAR = {'front': np.array([6.0, 3.0, 0.0]), 'side': np.array([10.0, -4.5, 0.0]),
        'rear': np.array([14.0, 3.0, 0.0])}
BETWEEN = np.array([7.0, -3.0, 0.0])
UP = {'direction': m.Direction.UPLINK}


def by_distance(scenario, position, covariance_m2, bands, surface):
    """Take the place of `choose_beam`, with a capacity inverse to the distance."""
    choice = plain_choice(scenario, position, covariance_m2, bands, surface)
    return types.SimpleNamespace(
        beam=choice.beam, expected_bps=1e7 / float(np.linalg.norm(position)))


class Walker:
    """A mobility whose position the test sets."""

    position = BETWEEN

    def state(self, now_s):
        return self.position, np.zeros(3)


class Sighter(Role):
    """Takes the place of a positioner; it locates the walker within 0.1 m."""

    SENDS = (m.Posterior,)
    RECEIVES = (m.ReceivedSignals,)

    def __init__(self, pose, walker):
        super().__init__()
        self._pose, self._walker = pose, walker

    def react(self, event):
        if not isinstance(event, m.ReceivedSignals):
            return
        self.send(posterior_of(event, Sighting(self._pose, Mixture(
            np.zeros(1), self._walker.position[None], 0.01 * np.eye(3)[None]))))


class SiteNetwork(Network):
    """The roles of a site with one walking user; `NodeSurface` routes their messages."""

    def __init__(self, site, **options):
        self.walker, self.site = Walker(), site
        self.ids = {one.scenario.id: name for name, one in site.surfaces.items()}
        first, *others = site.surfaces
        leader = site.surfaces[first]
        super().__init__(leader.scenario, leader.codebook, {1: self.walker}, **options)
        for name in (*(f'{other}/{role}' for other in others for role in FOLLOWING
                       if MEMBERS[role].role), 'fusion'):
            self.add(name)

    def _place(self, name):
        surface = '' if name == 'fusion' else name.rpartition('/')[0] or self.site.leader
        one = self.site.surfaces[surface or self.site.leader]
        return NodeSurface(one.scenario, site=self.site, name=surface)

    def _codebook_of(self, name):
        return self.site.surfaces[self._place(name).name].codebook

    def _receives(self, name, message, sender):
        place, member = self._place(name), MEMBERS[self._kind(name)]
        own = f'/{place.name}/' if place.name else '/'
        topic = self._place(sender).name
        sources = place.sources(self._roles[name].RECEIVES, member.from_all)
        return any(kind is type(message) and scenario.id == message.scenario_id
                   and (prefix or own) == (f'/{topic}/' if topic else '/')
                   for kind, prefix, scenario in sources)

    def publish(self, message, sender='external'):
        super().publish(dataclasses.replace(
            message, scenario_id=message.scenario_id or self._place(sender).scenario.id), sender)

    def _build(self, name):
        scenario, kind = self._place(name).scenario, self._kind(name)
        match kind:
            case 'positioner':
                return Sighter(scenario.pose, self.walker)
            case 'transmission':
                return Transmission(scenario, choose=by_distance,
                                    evaluate=lambda *_: CapacityReport(1e6, 1.1e6))
            case 'receiver':
                return Receiver(scenario, 0)
            case 'channel':
                return Channel(scenario, 0, Impairments(multipath_memory=False))
            case 'fusion':
                return Fusion(self.site, lambda: 0.0)
        return super()._build(name)

    def cycles_at(self, place, n=1):
        """Run cycles with the user at a place; return the surfaces that delivered the data."""
        self.walker.position = place
        before = len(self.log)
        self.run_cycles(n)
        return [self.ids[one.scenario_id] for one in self.sent(
            m.Data, before, stage=m.Stage.DELIVERED, **UP)]


@pytest.fixture(scope='module')
def make_site(scenario, codebooks):
    """Function that returns a site with the given surfaces, each with a codebook of its own."""
    def make(*names):
        bounds_m = np.array([[5.0, -5.0, -1.0], [15.0, 5.0, 1.0]])
        return Site({name: System(dataclasses.replace(
            scenario, pose=POSES[name], roi_center_m=(10.0, 0.0, 0.0),
            roi_size_m=(10.0, 10.0, 2.0)), codebook)
            for name, codebook in zip(names, codebooks, strict=False)}, bounds_m)
    return make


@pytest.fixture
def make_network(make_site):
    def make(*names, **options):
        net = SiteNetwork(make_site(*names), **{'retries': 3} | options)
        # At first, the base station does not know which surfaces answer.
        net.run_cycles(2)
        return net
    return make


@pytest.mark.slow
@pytest.mark.parametrize('names', [('front', 'side'), ('side', 'front', 'rear')])
def test_data_go_over_the_surface_with_the_largest_expected_capacity(make_network, names):
    net = make_network(*names)
    for _ in range(2):
        for name in names:
            assert net.cycles_at(NEAR[name], 2) == [name, name]
    assert net.served() == [1] * len(net.outcomes())
    assert net.counters() == {}
    # The data of the first of these cycles went over any surface.
    assert int(net['bs'].status()['handovers']) in (2 * len(names) - 1, 2 * len(names))


def test_every_surface_steers_to_the_position_of_the_site(make_network):
    net = make_network('front', 'side')
    net.cycles_at(NEAR['side'], 3)
    (estimate, *_), beams = (net.sent(kind, cycle_id=net['bs']._cycle.cycle_id)
                             for kind in (m.PositionEstimate, m.Beam))
    assert estimate.estimator == 'fusion of front, side'
    assert {net.ids[beam.scenario_id]: beam.expected_bps for beam in beams} == pytest.approx({
        name: 1e7 / np.linalg.norm(POSES[name].to_surface(estimate.position))
        for name in ('front', 'side')})
    reports = net.sent(m.Capacity)
    assert {net.ids[one.scenario_id] for one in reports} == {'front', 'side'}
    for report in reports:
        (beam,) = net.sent(m.Beam, cycle_id=report.cycle_id, scenario_id=report.scenario_id)
        assert report.expected_bps == beam.expected_bps


def test_one_surface_is_a_site_without_handovers(make_network):
    net = make_network('front')
    assert net.cycles_at(NEAR['rear'], 2) == ['front', 'front']
    assert net['bs'].status()['handovers'] == '0'
    assert net.counters() == {}


@pytest.mark.slow
def test_similar_capacities_cause_no_handover(make_network):
    net = make_network('front', 'side')
    net.change('bs', handover_ratio=1.1)
    for name in ('side', 'front'):
        net.cycles_at(NEAR[name])
        for off in (0.2, -0.2) * 4:
            assert net.cycles_at(BETWEEN + [off, off, 0.0]) == [name]
    net.change('bs', handover_ratio=1.0)
    net.cycles_at(BETWEEN)
    assert net.cycles_at(BETWEEN + [0.2, -0.2, 0.0]) == ['side']
    assert net.cycles_at(BETWEEN - [0.2, -0.2, 0.0]) == ['front']


@pytest.mark.parametrize('role', ['rhs_controller', 'transmission', 'receiver'])
def test_a_surface_that_does_not_answer_delays_one_cycle(make_network, role):
    net = make_network('front', 'side')
    net.cycles_at(NEAR['side'], 2)
    net.remove(f'side/{role}')
    # Without a receiver, fusion waits for the surface until it counts as silent.
    assert net.cycles_at(NEAR['side'], 4) == ['front'] * 4
    begin_s = net.now_s
    assert net.cycles_at(NEAR['side'], 5) == ['front'] * 5
    assert net.now_s - begin_s < 5 * (net.settings.rest_s + 0.1)
    net.add(f'side/{role}')
    net.cycles_at(NEAR['side'], 2)
    assert net.cycles_at(NEAR['side'], 2) == ['side'] * 2
    assert net.served() == [1] * len(net.outcomes())


@pytest.mark.slow
@pytest.mark.parametrize('rest_s', [0.0, 0.1])
def test_a_surface_that_is_always_slower_takes_part(make_network, rest_s):
    net = make_network('front', 'side', rest_s=rest_s)
    net.remove('side/transmission')
    net.cycles_at(NEAR['side'], 3)
    (side,) = [surface for surface, name in net.ids.items() if name == 'side']
    net.transport = faults(Fault(m.Beam, 'side/rhs_controller', 0.05),
                           Fault(m.Beam, 'bs', 0.05, scenario_id=side))
    net.add('side/transmission')
    net.cycles_at(NEAR['side'], 3)
    assert net.cycles_at(NEAR['side'], 3) == ['side'] * 3


@pytest.mark.slow
def test_data_that_a_surface_does_not_deliver_go_over_another_one_in_the_same_cycle(make_network):
    net = make_network('front', 'side', rest_s=1.0)
    net.cycles_at(NEAR['side'], 2)
    net.remove('side/channel')
    assert net.cycles_at(NEAR['side'], 5) == ['front'] * 5
    # The surface is not tried again at once.
    assert net['bs'].counters['retry_data'] == 1
    net.add('side/channel')
    while net.cycles_at(NEAR['side']) != ['side']:
        assert net.now_s < 30
    assert net.served() == [1] * len(net.outcomes())


@pytest.mark.slow
def test_data_under_way_during_a_handover_arrive(make_network):
    net = make_network('front', 'side')
    net.cycles_at(NEAR['side'], 2)
    net.transport = Fault(m.Data, 'side/channel', 0.3, stage=m.Stage.OFFERED, **UP)
    net.walker.position = NEAR['side']
    before = len(net.log)
    net.run_cycles(1)
    net.run(limit_s=0.05)
    delivered = net.sent(m.Data, before, stage=m.Stage.DELIVERED, **UP)
    # The base station offered the data again over the other surface, and those of both arrived.
    assert {net.ids[one.scenario_id] for one in delivered} == {'front', 'side'}
    assert {one.cycle_id for one in delivered} == {net.outcomes()[-1][0]}
    assert net.outcomes()[-1][2] == 'served'
    assert net['bs'].state is BsState.RESTING


@pytest.mark.slow
@pytest.mark.parametrize('kind', [m.PositionEstimate, m.Beam])
@pytest.mark.parametrize('recipient', ['bs', 'transmission', 'side/transmission'])
def test_one_lost_message_ends_no_cycle(make_network, kind, recipient):
    net = make_network('front', 'side')
    net.transport = lost = Fault(kind, recipient, n=1)
    net.cycles_at(NEAR['side'], 4)
    assert bool(lost.n_affected) == (kind in SUBSCRIPTIONS[net._kind(recipient)])
    assert net.served() == [1] * len(net.outcomes())


def test_a_position_behind_a_surface_has_no_beam_of_it(example, scenario):
    role = Transmission(dataclasses.replace(scenario, pose=POSES['rear']), choose=by_distance)
    behind = example(m.PositionEstimate, cycle_id=1, position=np.array([21.0, 0.0, 0.0]))
    assert role.handle(behind, 0.0) == []
    assert role.counters == {Outcome.BEHIND.value: 1}


def beams(**capacities):
    return {name: types.SimpleNamespace(expected_bps=bps) for name, bps in capacities.items()}


def test_a_surface_that_loses_data_is_avoided_for_some_time_or_until_it_delivers():
    carriers, both = Carriers(), beams(a=2.0, b=1.0)
    carriers.lose('a', 5.0)
    assert carriers.choose(1, both, 1.1, 5.0) == 'b'
    assert carriers.choose(1, beams(a=2.0), 1.1, 5.0) == 'a'
    assert carriers.choose(1, both, 1.1, 15.0) == 'a'
    carriers.lose('a', 20.0)
    carriers.lose('b', 20.0)
    assert carriers.choose(1, both, 1.1, 20.0) == 'a'
    carriers.deliver(1, 'b')
    assert carriers.choose(1, both, 1.1, 20.0) == 'b'


def test_only_surfaces_that_answered_before_are_awaited(example):
    beam, applied = example(m.Beam), example(m.RhsConfiguration)
    steering = Steering({'a', 'b'})
    steering.add('a', beam)
    assert not steering.is_complete_with('a', applied)
    steering.add('a', applied)
    steering.add('b', applied)
    assert set(steering.ready) == {'a'}
    assert steering.is_complete_with('b', beam)
    assert steering.next().awaited == {'a', 'b'}
    assert Steering({'a', 'b'}, {'a': beam}, {'a'}).next().awaited == {'a'}
    # No surface answers if no signals arrived.
    assert Steering({'a'}).next().awaited == {'a'}
