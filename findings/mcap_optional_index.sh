#!/usr/bin/env bash
# mcap 1.6.0: the reader that `make_reader` returns for a file misreads files whose writer left out optional parts of the
# summary, which a reader of the same bytes that does not seek reads rightly. Without an index of chunks,
# `iter_messages(reverse=True)` is in ascending order; without other indexes, there are no metadata; and without repeated
# channels, reading ends with a KeyError.
#
# Guess before the run: the same messages and metadata in the same order, as all files are from Writer of the same package
# and valid by the specification, which makes these parts optional. Source: `iter_messages` of SeekingReader, which does
# not pass `reverse` on where there is no index, and looks channels up in the summary only. The script fails if the
# behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check 'mcap==1.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import io
from importlib.metadata import version

from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import IndexType, Writer


def found(reader, stream):
    """Return times of messages in descending order, and names of metadata, or the error."""
    try:
        stream.seek(0)
        times = [message.log_time for *_, message in reader(stream).iter_messages(reverse=True)]
        stream.seek(0)
        names = [one.name for one in reader(stream).iter_metadata()]
    except KeyError as error:
        return [type(error).__name__]
    return [*times, *names]


print('mcap', version('mcap'))
for name, options in (('complete', {}), ('no indexes', {'index_types': IndexType.NONE}),
                      ('no chunks', {'use_chunking': False}),
                      ('no channels in the summary', {'repeat_channels': False})):
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start()
    channel = writer.register_channel('/topic', 'json', 0)
    for time in (1, 2, 3):
        writer.add_message(channel, log_time=time, data=b'{}', publish_time=time)
    writer.add_metadata('about', {})
    writer.finish()
    for reader in make_reader, NonSeekingReader:
        print(f'{name}, {reader.__name__}:', *found(reader, stream))
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == 'mcap 1.6.0
complete, make_reader: 3 2 1 about
complete, NonSeekingReader: 3 2 1 about
no indexes, make_reader: 1 2 3
no indexes, NonSeekingReader: 3 2 1 about
no chunks, make_reader: 1 2 3 about
no chunks, NonSeekingReader: 3 2 1 about
no channels in the summary, make_reader: KeyError
no channels in the summary, NonSeekingReader: 3 2 1 about' ]]
