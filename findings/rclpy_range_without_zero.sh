#!/usr/bin/env bash
# rclpy 7.1.6: a parameter with the range -0.3 to 0.3 in steps of 0.1 takes -0.1 and 0.1, but not 0.0. The tolerance of
# steps is relative to the value, so that it is zero for the value 0, and -0.3 + 3 * 0.1 is 6e-17. A node that declares
# such a parameter with the default 0.0 does not start.
#
# Guess before the run: 0.0 is taken, as the other steps are. Source: FloatingPointRange.msg of rcl_interfaces, which
# states the valid values and no exception; `_apply_floating_point_range` of Node. The script fails if the behaviour
# changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'ros-jazzy-rclpy[fastrtps]==7.1.6' 'ros-jazzy-common-interfaces==5.3.6'
cat > "$folder/observe.py" <<'PYTHON'
from importlib.metadata import version

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter

rclpy.init()
node = rclpy.create_node('observer')
print('rclpy', version('ros-jazzy-rclpy'))
for limit in (0.3, 0.4):
    descriptor = ParameterDescriptor(floating_point_range=[
        FloatingPointRange(from_value=-limit, to_value=limit, step=0.1)])
    name = f'offset_{limit}'.replace('.', '_')
    node.declare_parameter(name, limit, descriptor)
    for value in (-0.1, 0.0, 0.1):
        result, = node.set_parameters([Parameter(name, value=value)])
        print(f'range {limit}, value {value}:', 'taken' if result.successful else 'refused')
    try:
        node.declare_parameter(f'{name}_again', 0.0, descriptor)
        print(f'range {limit}, default 0.0: taken')
    except InvalidParameterValueException as error:
        print(f'range {limit}, default 0.0:', type(error).__name__)
rclpy.shutdown()
PYTHON
found=$(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-87} \
  timeout 60 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == 'rclpy 7.1.6
range 0.3, value -0.1: taken
range 0.3, value 0.0: refused
range 0.3, value 0.1: taken
range 0.3, default 0.0: InvalidParameterValueException
range 0.4, value -0.1: taken
range 0.4, value 0.0: taken
range 0.4, value 0.1: taken
range 0.4, default 0.0: taken' ]]
