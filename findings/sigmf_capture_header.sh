#!/usr/bin/env bash
# SigMF 1.14.0: read_samples_in_capture skips the header of a file twice, and so returns too few samples. Of a WAV file with
# 100 samples of 16 bits, read_samples returns all, and read_samples_in_capture the last 78 for its only capture: the
# header has 44 bytes.
#
# Guess before the run: the same 100 samples, as the documentation promises a capture in its entirety, and
# get_capture_byte_boundaries returns the bytes 44 to 244. Source: `_read_datafile` of SigMFFile, which adds the header to
# these bytes once more. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'sigmf==1.14.0' 'numpy==2.3.5'
cat > "$folder/observe.py" <<'PYTHON'
import sys
import wave
from importlib.metadata import version

import numpy as np
import sigmf

path = f'{sys.argv[1]}/ramp.wav'
with wave.open(path, 'wb') as file:
    file.setnchannels(1)
    file.setsampwidth(2)
    file.setframerate(8000)
    file.writeframes(np.arange(1, 101, dtype='<i2').tobytes())
recording = sigmf.fromfile(path)
print('sigmf', version('sigmf'), 'captures:', len(recording.get_captures()), 'bytes:',
      *recording.get_capture_byte_boundaries(0))
for name, samples in (('all', recording[:]), ('read_samples', recording.read_samples()),
                      ('read_samples_in_capture', recording.read_samples_in_capture(0))):
    # Samples are scaled to -1 to 1.
    first, last = np.rint(2**15 * samples[[0, -1]]).astype(int)
    print(f'{name}: {len(samples)} samples, {first} to {last}')
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" "$folder/observe.py" "$folder")
echo "$found"
[[ $found == 'sigmf 1.14.0 captures: 1 bytes: 44 244
all: 100 samples, 1 to 100
read_samples: 100 samples, 1 to 100
read_samples_in_capture: 78 samples, 23 to 100' ]]
