#!/usr/bin/env bash
# rosbags 0.11.9: of an MCAP file without indexes of messages, or without channels in its summary, Reader returns no
# messages, without an error, although its `message_count` is right. If the summary has neither schemas nor channels, all
# messages are read.
#
# Guess before the run: all messages, as from other readers. Writer of mcap 1.6.0 leaves out either part by an option, and
# the specification of MCAP makes both optional. Source: McapReader of rosbags, which searches for messages only in chunks
# whose index lists their channel. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'rosbags==0.11.9' 'mcap==1.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

from mcap.reader import NonSeekingReader
from mcap.writer import IndexType, Writer
from rosbags.rosbag2 import Reader

path = Path(sys.argv[1]) / 'bag.mcap'
print('rosbags', version('rosbags'), 'mcap', version('mcap'))
for name, options in (('complete', {}), ('no indexes of messages', {'index_types': IndexType.CHUNK}),
                      ('no channels', {'repeat_channels': False}),
                      ('no schemas, no channels', {'repeat_channels': False,
                                                   'repeat_schemas': False})):
    with path.open('wb') as stream:
        writer = Writer(stream, **options)
        writer.start(profile='ros2')
        channel = writer.register_channel(
            '/topic', 'cdr', writer.register_schema('std_msgs/msg/Int8', 'ros2msg', b'int8 data'))
        for time in (1, 2, 3):
            writer.add_message(channel, log_time=time, data=b'\0\1\0\0\7', publish_time=time)
        writer.finish()
    with Reader(path) as reader:
        found = len(list(reader.messages()))
        print(f'{name}: message_count {reader.message_count}, messages {found}', end=', ')
    with path.open('rb') as stream:
        print('by mcap', len(list(NonSeekingReader(stream).iter_messages())))
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" "$folder/observe.py" "$folder")
echo "$found"
[[ $found == 'rosbags 0.11.9 mcap 1.6.0
complete: message_count 3, messages 3, by mcap 3
no indexes of messages: message_count 3, messages 0, by mcap 3
no channels: message_count 3, messages 0, by mcap 3
no schemas, no channels: message_count 3, messages 3, by mcap 3' ]]
