#!/usr/bin/env bash
# mcap 1.6.0: `iter_messages(reverse=True)` returns messages in ascending order if a file has no index of chunks, such as
# one without chunks. A reader of the same file that does not seek returns them in descending order.
#
# Guess before the run: descending in all cases, as the documentation of the argument says. Source: `iter_messages` of
# SeekingReader, which does not pass the argument on to the reader that it uses for files without an index. The script
# fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check 'mcap==1.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import io
from importlib.metadata import version

from mcap.reader import NonSeekingReader, SeekingReader, make_reader
from mcap.writer import IndexType, Writer

print('mcap', version('mcap'))
for name, options in (('with an index', {}), ('without an index', {'index_types': IndexType.NONE}),
                      ('without chunks', {'use_chunking': False})):
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start()
    channel = writer.register_channel('/topic', 'json', 0)
    for time in (1, 2, 3):
        writer.add_message(channel, log_time=time, data=b'{}', publish_time=time)
    writer.finish()
    for reader in make_reader, SeekingReader, NonSeekingReader:
        stream.seek(0)
        print(f'{name}, {reader.__name__}:', *(
            message.log_time for *_, message in reader(stream).iter_messages(reverse=True)))
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == 'mcap 1.6.0
with an index, make_reader: 3 2 1
with an index, SeekingReader: 3 2 1
with an index, NonSeekingReader: 3 2 1
without an index, make_reader: 1 2 3
without an index, SeekingReader: 1 2 3
without an index, NonSeekingReader: 3 2 1
without chunks, make_reader: 1 2 3
without chunks, SeekingReader: 1 2 3
without chunks, NonSeekingReader: 3 2 1' ]]
