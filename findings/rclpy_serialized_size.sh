#!/usr/bin/env bash
# rclpy 7.1.6 with rmw_fastrtps_cpp: serialize_message appends four or more bytes that belong to no field if a message
# contains empty arrays of eight-byte numbers, such as a JointState without velocities and efforts. rosbags 0.11.9 refuses
# such bytes; messages from the wire are as long as they should be.
#
# Guess before the run: the size of the message, as on the wire. The tutorials of rosbag2 record messages in this way. The
# script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'ros-jazzy-rclpy[fastrtps]==7.1.6' 'ros-jazzy-common-interfaces==5.3.6' 'rosbags==0.11.9'
cat > "$folder/observe.py" <<'PYTHON'
from importlib.metadata import version

import rclpy
from rclpy.serialization import serialize_message
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

NAME = 'sensor_msgs/msg/JointState'
store = get_typestore(Stores.ROS2_JAZZY)
rclpy.init()
node, received = rclpy.create_node('observer'), []
node.create_subscription(JointState, 'joints', received.append, 10, raw=True)
publisher = node.create_publisher(JointState, 'joints', 10)


def size(data):
    """Return the size of a message that rosbags reads, or the name of its error."""
    try:
        return len(store.serialize_cdr(store.deserialize_cdr(data, NAME), NAME))
    except SerdeError as error:
        return type(error).__name__


print('rclpy', version('ros-jazzy-rclpy'), 'rosbags', version('rosbags'))
for efforts in ([1.0], []):
    message = JointState(name=['a'], position=[1.0], velocity=efforts, effort=efforts)
    received.clear()
    while not received:
        publisher.publish(message)
        rclpy.spin_once(node, timeout_sec=0.1)
    for kind, data in ('serialize_message', serialize_message(message)), ('wire', received[0]):
        print(f'efforts {efforts}, {kind}: {len(data)} bytes, rosbags:', size(data))
rclpy.shutdown()
PYTHON
found=$(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-87} \
  timeout 120 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == 'rclpy 7.1.6 rosbags 0.11.9
efforts [1.0], serialize_message: 76 bytes, rosbags: 76
efforts [1.0], wire: 76 bytes, rosbags: 76
efforts [], serialize_message: 60 bytes, rosbags: SerdeError
efforts [], wire: 52 bytes, rosbags: 52' ]]
