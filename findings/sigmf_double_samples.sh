#!/usr/bin/env bash
# SigMF 1.14.0: `read_samples` and `read_samples_in_capture` convert samples of 64 bits (rf64, cf64) to 32 bits: what is
# larger than 3e38 becomes infinite, and what is smaller than 1e-45 becomes zero, without a warning. A slice of the same
# file keeps their type. A loop over a file of one channel yields arrays of one sample, so that `np.asarray` of the file
# has one dimension more than its slice and its `shape`.
#
# Guess before the run: all ways to read a file return the same values, as the documentation of the datatypes states 64
# bits. Source: SigMFFile of sigmf-python. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check 'sigmf==1.14.0' 'numpy==2.3.5'
cat > "$folder/observe.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import sigmf

print('sigmf', version('sigmf'))
for datatype, samples in (('cf64_le', np.array([1 + 1e-9j, 1e50, 1e-50], '<c16')),
                          ('rf64_le', np.array([1 + 1e-9, 1e50, 1e-50], '<f8'))):
    stem = Path(sys.argv[1], datatype)
    samples.tofile(stem.with_suffix('.sigmf-data'))
    written = sigmf.SigMFFile(data_file=str(stem.with_suffix('.sigmf-data')), global_info={
        'core:datatype': datatype, 'core:sample_rate': 1e6, 'core:version': '1.2.0'})
    written.add_capture(0)
    written.tofile(str(stem.with_suffix('.sigmf-meta')))
    file = sigmf.fromfile(str(stem.with_suffix('.sigmf-meta')))
    for name, read in (('slice', file[:]), ('read_samples', file.read_samples()),
                       ('read_samples_in_capture', file.read_samples_in_capture(0))):
        print(datatype, f'{name}: {read.dtype},',
              'equal' if np.array_equal(read, samples) else f'{abs(read)}, {read[0] - 1:.0e}')
    print(datatype, f'shape {file.shape}, of a slice {file[:].shape}, of an array {np.asarray(file).shape}')
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" -W ignore "$folder/observe.py" "$folder")
echo "$found"
[[ $found == 'sigmf 1.14.0
cf64_le slice: complex128, equal
cf64_le read_samples: complex64, [ 1. inf  0.], 0e+00+1e-09j
cf64_le read_samples_in_capture: complex64, [ 1. inf  0.], 0e+00+1e-09j
cf64_le shape (3,), of a slice (3,), of an array (3, 1)
rf64_le slice: float64, equal
rf64_le read_samples: float32, [ 1. inf  0.], 0e+00
rf64_le read_samples_in_capture: float32, [ 1. inf  0.], 0e+00
rf64_le shape (3,), of a slice (3,), of an array (3, 1)' ]]
