"""Names and quality of service of the topics."""

import re
from pathlib import Path

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, OBSERVATION, profile_for
from rhs_isac_ros.ros.recording import recorded_topics, type_name
from rhs_isac_ros.ros.roster import ROSTER

ALL = [*topics.NAMES.values(), topics.POSITION, topics.CODEBOOK]


def test_every_message_has_its_own_topic():
    assert set(topics.NAMES) == set(m.Message.__subclasses__())
    assert len(set(ALL)) == len(ALL)


def test_only_the_statistics_are_latched():
    assert {kind for kind in topics.NAMES if profile_for(kind) is LATCHED} == {
        m.CapacityStatistics}
    assert {kind for kind in topics.NAMES if profile_for(kind) is EXCHANGE} == set(
        topics.NAMES) - {m.CapacityStatistics, m.Ack}


def test_the_queue_of_acks_holds_those_of_all_users():
    assert profile_for(m.Ack).depth == MAX_USERS
    assert profile_for(m.Ack, OBSERVATION) is OBSERVATION


def test_the_table_of_the_documentation_is_that_of_the_code():
    page = (Path(__file__).parents[2] / 'docs' / 'interfaces.rst').read_text(encoding='utf-8')
    rows = {name: (kind, published, received, quality) for name, kind, published, received, quality
            in re.findall(r'^   "``([a-z_/]+)``", "``([A-Za-z_/]+)``", "([a-z_, ]*)", '
                          r'"([a-z_, ]*)", "([a-z]+, \d+)"$', page, re.M)}
    recorded = recorded_topics()
    assert rows.keys() - {topics.MARKERS} == recorded.keys()
    for name, (kind, profile) in recorded.items():
        senders = {role for role, member in ROSTER.items() if name in member.sent}
        receivers = {role for role, member in ROSTER.items() if name in member.received}
        latched = profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
        # Each publisher of announcements keeps one, a subscription those of all.
        depth = 1 if latched else profile.depth
        assert rows[name] == (
            type_name(kind).replace('/msg/', '/').removeprefix('rhs_isac_msgs/'),
            'every node except visualizer' if name == topics.DIAGNOSTICS
            else ', '.join(sorted(senders)), ', '.join(sorted(receivers)),
            f'{"latched" if latched else "volatile"}, {depth}')
        assert profile.reliability is ReliabilityPolicy.RELIABLE
