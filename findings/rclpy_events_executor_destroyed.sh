#!/usr/bin/env bash
# rclpy 7.1.6: a subscription that its own callback destroys still receives the messages that have arrived before, if the
# executor is the EventsExecutor, although the node no longer lists it. Other executors call the callback once. A program
# that takes one message and then destroys the subscription handles several.
#
# Guess before the run: no callback after `destroy_subscription`, as with SingleThreadedExecutor. Sources:
# rclpy/node.py and rclpy/experimental/events_executor.py. The script fails if the behaviour changes.
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
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from std_msgs.msg import String


def observe(executor_type):
    """Return the messages that a callback gets which destroys its subscription."""
    rclpy.init()
    node, executor, received = rclpy.create_node('observer'), executor_type(), []
    executor.add_node(node)

    def receive(message):
        received.append((message.data, len(list(node.subscriptions))))
        if len(received) == 1:
            node.destroy_subscription(subscription)

    subscription = node.create_subscription(String, 'words', receive, 10)
    publisher = node.create_publisher(String, 'words', 10)
    deadline_s = time.monotonic() + 20
    while not publisher.get_subscription_count() and time.monotonic() < deadline_s:
        executor.spin_once(timeout_sec=0.1)
    before = len(list(node.subscriptions))
    for word in 'abcd':
        publisher.publish(String(data=word))
    publisher.wait_for_all_acked()
    end_s = time.monotonic() + 1
    while time.monotonic() < end_s:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()
    return ', '.join(f'{word} with {count - before:+d}' for word, count in received)


print('rclpy', version('ros-jazzy-rclpy'))
for one in (SingleThreadedExecutor, MultiThreadedExecutor, EventsExecutor):
    print(f'{one.__name__}: callback for {observe(one)} subscriptions')
PYTHON
found=$(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-87} \
  timeout 120 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == 'rclpy 7.1.6
SingleThreadedExecutor: callback for a with +0 subscriptions
MultiThreadedExecutor: callback for a with +0 subscriptions
EventsExecutor: callback for a with +0, b with -1, c with -1, d with -1 subscriptions' ]]
