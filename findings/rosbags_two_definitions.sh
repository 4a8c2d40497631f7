#!/usr/bin/env bash
# rosbags 0.11.9: AnyReader decodes all bags with the definition of the last one, if they define a type of one name
# differently, such as before and after a field was moved. Values are then those of other fields, without an error.
#
# Guess before the run: an error, or each bag with its own definition. Each connection has the definition and the hash of
# its type, and a store of types refuses a second definition. Source: `_open` of AnyReader, which replaces definitions of
# the same name, and compares only the last hash. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check 'rosbags==0.11.9'
cat > "$folder/observe.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

NAME = 'lab_msgs/msg/Size'


def bag(name, definition):
    """Write a message with the width 1 and the height 2."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, NAME))
    path = Path(sys.argv[1]) / f'{name}.bag'
    with Writer(path) as writer:
        connection = writer.add_connection(f'/{name}', NAME, typestore=store)
        message = store.types[NAME](width=1.0, height=2.0)
        writer.write(connection, 0, store.serialize_ros1(message, NAME))
    return path


old = bag('old', 'float64 width\nfloat64 height\n')
new = bag('new', 'float64 height\nfloat64 width\n')
print('rosbags', version('rosbags'))
for paths in [old], [new], [old, new], [new, old]:
    with AnyReader(paths) as reader:
        found = {connection.topic: reader.deserialize(data, connection.msgtype)
                 for connection, _, data in reader.messages()}
    print(*(path.stem for path in paths), 'is read as', *(
        f'{topic} {found[topic].width:g} x {found[topic].height:g}' for topic in sorted(found)))
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" "$folder/observe.py" "$folder")
echo "$found"
[[ $found == 'rosbags 0.11.9
old is read as /old 1 x 2
new is read as /new 1 x 2
old new is read as /new 1 x 2 /old 2 x 1
new old is read as /new 2 x 1 /old 1 x 2' ]]
