"""The example of a user that knows only the documented topics."""

import subprocess
import sys
from pathlib import Path

from rclpy.qos import QoSCompatibility, qos_check_compatible

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import LATCHED
from rhs_isac_ros.ros.roster import ROSTER

EXAMPLE = Path(__file__).parents[2] / 'docs' / 'examples' / 'user_node.py'
# Topics that a role receives.
TOPICS = sorted({topic for member in ROSTER.values() for topic in member.received})


def test_the_example_is_served_without_repetitions(processes, make_watch):
    space, watch = '/example', make_watch('/example')
    # Programs start as slowly as the example, so that it discovers all of them before its cycle.
    running = [processes.start(role, namespace=space, as_program=True)
               for role in ROSTER if role != 'user']
    with subprocess.Popen(
            [sys.executable, str(EXAMPLE), '--ros-args', '-r', f'__ns:={space}']) as user:
        try:
            watch.until_served(5, user=7, processes=running)
            watch.until(lambda: not list(_incomplete(watch.node, space)), 'all endpoints', running)
            _check_compatibility(watch.node, space)
        finally:
            user.terminate()
    assert user.returncode == 0
    assert not watch.given_up
    # A request is repeated after a quarter of a second. The watch may find the publisher of the
    # requests after the first cycles.
    requests = [len(watch.of_cycle(m.PilotRequest, end.cycle_id)) for end in watch.served[:5]]
    assert max(requests) == 1


def _incomplete(node, space):
    """Yield the topics between roles without a publisher or without a subscriber."""
    for topic in TOPICS:
        for infos in (node.get_publishers_info_by_topic(f'{space}/{topic}'),
                      node.get_subscriptions_info_by_topic(f'{space}/{topic}')):
            if not {info.node_name for info in infos} - {node.get_name()}:
                yield topic


def _check_compatibility(node, space):
    """Check that publishers and subscribers are compatible, and that no topic is hidden."""
    for topic in TOPICS:
        publishers = node.get_publishers_info_by_topic(f'{space}/{topic}')
        subscribers = node.get_subscriptions_info_by_topic(f'{space}/{topic}')
        for publisher in publishers:
            for subscriber in subscribers:
                assert qos_check_compatible(publisher.qos_profile, subscriber.qos_profile)[0] != (
                    QoSCompatibility.ERROR), topic
    # Those of an action are hidden by the convention of ROS.
    hidden = [name for name, _ in node.get_topic_names_and_types()
              if any(part.startswith('_') and part != '_action' for part in name.split('/'))]
    assert not hidden


def test_one_message_by_hand_is_answered(processes, make_watch):
    """As ``ros2 topic pub --once`` sends it: when there is a subscriber, and once."""
    space, watch = '/hand', make_watch('/hand')
    running = [processes.start('user', namespace=space, user_id=4),
               processes.start('channel', namespace=space)]
    beacon = watch.node.create_publisher(ros.Beacon, 'beacon', 10)
    # A node by hand announces its role, as ``ros2 topic pub presence`` does.
    presence = watch.node.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
    watch.node.create_timer(0.4, lambda: presence.publish(
        ros.Presence(sender=1, role='bs', node=f'{space}/bs', scenario='{}')))
    watch.until(lambda: 'listening for beacons' in running[0].log, 'the user', running)
    watch.until(lambda: beacon.get_subscription_count() > 1, 'the subscription', running)
    beacon.publish(ros.Beacon(cycle_id=5, first_user=1, last_user=9))
    watch.until(lambda: watch.received[m.Ack], 'the answer', running)
    (ack,) = watch.received[m.Ack]
    assert (ack.cycle_id, ack.user) == (5, 4)
