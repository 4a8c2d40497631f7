#!/usr/bin/env bash
# DeepMIMO 4.0.5: the channel at a sub-carrier is divided by the root of the number of sub-carriers
# of the band. A single path of 0 dB has the magnitude 1/8 with 64 sub-carriers and 1/16 with 256.
#
# Guess before the run: the magnitude is 1 with any number. The script fails if the behaviour
# changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'deepmimo==4.0.5' 'numpy==2.2.6'
cat > "$folder/observe.py" <<'PYTHON'
from importlib.metadata import version

import deepmimo
import numpy as np


def magnitude(n_subcarriers):
    """Return the magnitude of a channel of one path, 0 dB, one antenna each."""
    dataset = deepmimo.Dataset()
    one_path = {'power': 0.0, 'phase': 0.0, 'delay': 1e-7, 'aod_az': 0.0, 'aod_el': 90.0,
                'aoa_az': 180.0, 'aoa_el': 90.0, 'inter': 0.0}
    for name, value in one_path.items():
        setattr(dataset, name, np.array([[value]]))
    dataset.tx_pos, dataset.rx_pos = np.array([[0.0, 0.0, 0.0]]), np.array([[30.0, 0.0, 0.0]])
    dataset.scene = deepmimo.Scene()
    parameters = deepmimo.ChannelParameters()
    parameters.bs_antenna.shape = parameters.ue_antenna.shape = np.array([1, 1])
    parameters.ofdm.subcarriers = n_subcarriers
    parameters.ofdm.selected_subcarriers = np.array([0])
    return abs(dataset.compute_channels(parameters).item())


print('deepmimo', version('deepmimo'))
for n in (64, 256):
    print(f'{n} sub-carriers: magnitude {magnitude(n):.4f}')
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" "$folder/observe.py" 2>"$folder/log" |
  grep -e '^deepmimo ' -e '^[0-9]* sub-carriers: ')
echo "$found"
[[ $found == $'deepmimo 4.0.5\n64 sub-carriers: magnitude 0.1250\n256 sub-carriers: magnitude 0.0625' ]]
