#!/usr/bin/env bash
# rosbags 0.11.9, mcap 1.6.0: an empty selection of connections reads the whole bag, an empty
# selection of topics reads nothing. A program that selects the connections of a topic by rosbags
# thus gets all messages of a bag without this topic.
#
# Guess before the run: both return no message. Source: Reader.messages of rosbags, whose default for
# `connections` is an empty tuple. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'rosbags==0.11.9' 'mcap==1.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import importlib.metadata
import sys
from pathlib import Path

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
text = store.types['std_msgs/msg/String']
bag = Path(sys.argv[1]) / 'bag'
with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    for number, topic in enumerate(('/first', '/second')):
        connection = writer.add_connection(topic, text.__msgtype__, typestore=store)
        message = store.serialize_cdr(text(data=topic), text.__msgtype__)
        writer.write(connection, 10 + number, message)
with Reader(bag) as reader:
    for topic in ('/first', '/absent'):
        selected = [one for one in reader.connections if one.topic == topic]
        read = [connection.topic for connection, _, _ in reader.messages(connections=selected)]
        print('rosbags', importlib.metadata.version('rosbags'), 'connections of', topic, read)
with (bag / 'bag.mcap').open('rb') as file:
    read = [channel.topic for _, channel, _ in make_reader(file).iter_messages(topics=[])]
print('mcap', importlib.metadata.version('mcap'), 'no topics', read)
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" "$folder/observe.py" "$folder")
echo "$found"
[[ $found == "rosbags 0.11.9 connections of /first ['/first']
rosbags 0.11.9 connections of /absent ['/first', '/second']
mcap 1.6.0 no topics []" ]]
