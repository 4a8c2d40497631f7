#!/usr/bin/env bash
# rclpy 7.1.6: `parameter_dict_from_yaml_file`, with which AsyncParameterClient loads a file into a running node, reads
# each value as YAML, converts it to text and reads that again. A quoted number becomes a number, a text of two lines
# becomes one of one line, and infinities, NaN and numbers with an exponent become texts. The same file, given to a node
# as `--params-file`, has the stated types. The two readers also differ for `y`, 1:30, 1_000, 0b11 and a date, as only
# the second one follows YAML 1.1 there.
#
# Guess before the run: one file sets the same values at the start and later. Source: rclpy/parameter.py; the part on
# exponents is known (ros2/rclpy issue 1672). The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'ros-jazzy-rclpy[fastrtps]==7.1.6' 'ros-jazzy-common-interfaces==5.3.6'
cat > "$folder/observe.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import rclpy
from rclpy.parameter import parameter_dict_from_yaml_file, parameter_value_to_python

VALUES = {'serial': '"0042"', 'version': '"1.10"', 'note': '|\n      one\n      two', 'limit': '.inf',
          'unknown': '.nan', 'noise': '1.0e-9', 'offsets': '[0.00001, 1.0]', 'gain': '2.5', 'axis': 'y',
          'clock': '1:30', 'width': '1_000', 'mask': '0b11', 'day': '2026-11-30'}
print('rclpy', version('ros-jazzy-rclpy'))
path = Path(sys.argv[1], 'parameters.yaml')
for name, value in VALUES.items():
    path.write_text(f'/**:\n  ros__parameters:\n    {name}: {value}\n')
    rclpy.init(args=['--ros-args', '--params-file', str(path)])
    node = rclpy.create_node('observer', automatically_declare_parameters_from_overrides=True)
    started = node.get_parameter(name).value
    node.destroy_node()
    rclpy.shutdown()
    loaded = parameter_value_to_python(
        parameter_dict_from_yaml_file(str(path), use_wildcard=True)[name].value)
    print(f'{name}: {list(started) if name == "offsets" else started!r} at the start, {loaded!r} loaded')
PYTHON
found=$(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-87} \
  timeout 120 "$folder/venv/bin/python" "$folder/observe.py" "$folder")
echo "$found"
[[ $found == "rclpy 7.1.6
serial: '0042' at the start, 34 loaded
version: '1.10' at the start, 1.1 loaded
note: 'one\\ntwo\\n' at the start, 'one two' loaded
limit: inf at the start, 'inf' loaded
unknown: nan at the start, 'nan' loaded
noise: 1e-09 at the start, '1e-09' loaded
offsets: [1e-05, 1.0] at the start, '[1e-05, 1.0]' loaded
gain: 2.5 at the start, 2.5 loaded
axis: True at the start, 'y' loaded
clock: '1:30' at the start, 90 loaded
width: '1_000' at the start, 1000 loaded
mask: '0b11' at the start, 3 loaded
day: '2026-11-30' at the start, datetime.date(2026, 11, 30) loaded" ]]
