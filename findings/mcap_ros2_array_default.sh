#!/usr/bin/env bash
# mcap-ros2-support 0.6.0: a message cannot be written if its definition gives an array a default, although its value is
# passed. Defaults of numbers and texts are taken where there is no value, and messages of the same type can be read.
#
# Guess before the run: the values that were passed. ROS 2 documents such defaults with an example in its page on
# interfaces. Source: `_write_complex_type`, which uses the default of an array as that of each entry. The script fails if
# the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'mcap==1.6.0' 'mcap-ros2-support==0.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import io
from importlib.metadata import version

from mcap.reader import make_reader
from mcap.writer import Writer as PlainWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

NAME = 'lab_msgs/msg/Numbers'


def read(stream):
    """Return the field of the only message."""
    stream.seek(0)
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    return [message.data for *_, message in reader.iter_decoded_messages()][0]


def written(definition, values):
    """Write and read a message; return its field, or the error."""
    stream = io.BytesIO()
    try:
        with Writer(stream) as writer:
            writer.write_message('/topic', writer.register_msgdef(NAME, definition), values, 0)
    except ValueError as error:
        return f'{type(error).__name__}: {error}'
    return read(stream)


print('mcap-ros2-support', version('mcap-ros2-support'))
for definition, values in (('float64 data 7.5', {}), ('float64[] data', {'data': [1.0, 2.0]}),
                           ('float64[] data [7.5]', {'data': [1.0, 2.0]}),
                           ('float64[2] data [7.5, 8.5]', {'data': [1.0, 2.0]})):
    print(f'{definition}, {values}:', written(definition, values))
stream = io.BytesIO()
writer = PlainWriter(stream)
writer.start(profile='ros2')
channel = writer.register_channel('/topic', 'cdr', writer.register_schema(
    NAME, 'ros2msg', b'uint8[] data [7]'))
writer.add_message(channel, log_time=0, data=b'\0\1\0\0\2\0\0\0\1\2', publish_time=0)
writer.finish()
print('uint8[] data [7], read:', list(read(stream)))
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
error='ValueError: Default value for primitive types cannot be an array'
[[ $found == "mcap-ros2-support 0.6.0
float64 data 7.5, {}: 7.5
float64[] data, {'data': [1.0, 2.0]}: [1.0, 2.0]
float64[] data [7.5], {'data': [1.0, 2.0]}: $error
float64[2] data [7.5, 8.5], {'data': [1.0, 2.0]}: $error
uint8[] data [7], read: [1, 2]" ]]
