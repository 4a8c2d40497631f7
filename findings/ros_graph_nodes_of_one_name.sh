#!/usr/bin/env bash
# rclpy 7.1.6 with rmw_fastrtps_cpp: if two participants have a node of the same name, a query for the
# topics of this name returns those of only one node, also to the other. If one participant has both
# nodes, it returns the topics of both.
#
# Guess before the run: it returns the topics of both in each case. The script fails if the behaviour
# changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'ros-jazzy-rclpy[fastrtps]==7.1.6' 'ros-jazzy-common-interfaces==5.3.6'
cat > "$folder/observe.py" <<'PYTHON'
import time
from importlib.metadata import version

import rclpy
from rclpy.context import Context
from std_msgs.msg import String


def topics(node):
    """Return the topics that the graph lists for the publishers of the node's name."""
    return [name for name, _ in node.get_publisher_names_and_types_by_node('twin', '/')
            if name not in ('/rosout', '/parameter_events')]


print('rclpy', version('ros-jazzy-rclpy'))
for n_participants in (1, 2):
    contexts = [Context() for _ in range(n_participants)]
    for context in contexts:
        rclpy.init(context=context)
    nodes = [rclpy.create_node('twin', context=context) for context in (contexts * 2)[:2]]
    for name, node in zip(('/first', '/second'), nodes):
        node.create_publisher(String, name, 10)
    end_s = time.monotonic() + 10
    while time.monotonic() < end_s and not all(
            node.get_node_names().count('twin') == 2 and node.count_publishers(name)
            for node in nodes for name in ('/first', '/second')):
        time.sleep(0.05)
    # Which of the two nodes is found depends on the random identifiers of the participants.
    print('participants:', n_participants, 'topics found by each node:', *(
        len(topics(node)) for node in nodes), 'and by both:', len({
            name for node in nodes for name in topics(node)}))
    for context in contexts:
        rclpy.shutdown(context=context)
PYTHON
found=$(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-87} \
  timeout 60 "$folder/venv/bin/python" "$folder/observe.py" 2>/dev/null)
echo "$found"
[[ $found == 'rclpy 7.1.6
participants: 1 topics found by each node: 2 2 and by both: 2
participants: 2 topics found by each node: 1 1 and by both: 1' ]]
