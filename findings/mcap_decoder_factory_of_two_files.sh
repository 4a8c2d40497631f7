#!/usr/bin/env bash
# mcap-ros2-support 0.6.0 and mcap-protobuf-support 0.6.0 with mcap 1.6.0: a DecoderFactory that serves readers of two files
# decodes the second file with the schemas of the first one that have the same numbers. Each file numbers its own schemas,
# so that values are wrong, often without an error.
#
# Guess before the run: the same values as with a factory of its own for each file, because the reader passes the whole
# schema to `decoder_for`, and the documentation does not restrict a factory to one file. Source: `decoder_for` of both
# packages, which keeps decoders by the number of the schema. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'mcap==1.6.0' 'mcap-ros2-support==0.6.0' 'mcap-protobuf-support==0.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import io
from importlib.metadata import version

import mcap_protobuf.decoder
import mcap_protobuf.writer
import mcap_ros2.decoder
import mcap_ros2.writer
from google.protobuf.wrappers_pb2 import DoubleValue, UInt64Value
from mcap.reader import make_reader


def ros2(names):
    """Return a file with a message 1 of each type."""
    stream = io.BytesIO()
    with mcap_ros2.writer.Writer(stream) as writer:
        for name in names:
            schema = writer.register_msgdef(f'std_msgs/msg/{name}', f'{name.lower()} data')
            writer.write_message(f'/{name}', schema, {'data': 1}, 0)
    return stream


def protobuf(names):
    """Return a file with a message 1 of each type."""
    stream = io.BytesIO()
    with mcap_protobuf.writer.Writer(stream) as writer:
        for name in names:
            kind = {'Float64': DoubleValue, 'Int64': UInt64Value}[name]
            writer.write_message(f'/{name}', kind(value=1), 0)
    return stream


for package, write, module, field in (
        ('mcap-ros2-support', ros2, mcap_ros2.decoder, 'data'),
        ('mcap-protobuf-support', protobuf, mcap_protobuf.decoder, 'value')):
    print(package, version(package))
    shared = module.DecoderFactory()
    for names in ['Float64', 'Int64'], ['Int64', 'Float64']:
        for kind, factory in ('own', module.DecoderFactory()), ('shared', shared):
            stream = write(names)
            stream.seek(0)
            reader = make_reader(stream, decoder_factories=[factory])
            found = {channel.topic: getattr(message, field) for _, channel, _, message
                     in reader.iter_decoded_messages()}
            print(f'{kind} factory:', *(f'{name} {found["/" + name]}' for name in sorted(names)))
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
right='Float64 1.0 Int64 1'
[[ $found == "mcap-ros2-support 0.6.0
own factory: $right
shared factory: $right
own factory: $right
shared factory: Float64 4607182418800017408 Int64 5e-324
mcap-protobuf-support 0.6.0
own factory: $right
shared factory: $right
own factory: $right
shared factory: Float64 0 Int64 0.0" ]]
