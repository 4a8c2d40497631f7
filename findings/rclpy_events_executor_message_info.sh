#!/usr/bin/env bash
# rclpy 7.1.6: a callback with the parameters message and info receives two arguments from the
# SingleThreadedExecutor, but a single tuple of both from the EventsExecutor.
#
# Guess before the run: both executors pass two arguments. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'ros-jazzy-rclpy[fastrtps]==7.1.6' 'ros-jazzy-common-interfaces==5.3.6'
cat > "$folder/observe.py" <<'PYTHON'
import inspect
from importlib.metadata import version

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from std_msgs.msg import String


def arguments(kind):
    """Return the types of the arguments of a callback that asks for the message info."""
    node, calls = rclpy.create_node('observer'), []

    def receive(*found):
        calls.append([type(one).__name__ for one in found])

    # rclpy decides by the signature, which here is that of a callback with two parameters.
    receive.__signature__ = inspect.signature(lambda message, info: None)
    node.create_subscription(String, 'chatter', receive, 10)
    publisher, executor = node.create_publisher(String, 'chatter', 10), kind()
    executor.add_node(node)
    for _ in range(100):
        publisher.publish(String(data='text'))
        executor.spin_once(timeout_sec=0.1)
        if calls:
            break
    node.destroy_node()
    return calls[0]


rclpy.init()
print('rclpy', version('ros-jazzy-rclpy'))
for kind in (SingleThreadedExecutor, EventsExecutor):
    print(kind.__name__, *arguments(kind))
rclpy.shutdown()
PYTHON
found=$(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-87} \
  timeout 60 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == $'rclpy 7.1.6\nSingleThreadedExecutor String dict\nEventsExecutor tuple' ]]
