#!/usr/bin/env bash
# DeepMIMO 4.0.5: the Doppler shift of a receiver that moves along the x axis has the wrong sign: one that moves away has
# a positive shift. The angles of arrival become the vector of propagation by negation of the distance and of both
# angles, which inverts y and z, but not x. Shifts of a moving transmitter, and of a receiver along y and z, are right.
# The opposite velocity along x gives the right shifts.
#
# Guess before the run: (velocity of the transmitter - velocity of the receiver) . direction / wavelength for the direct
# path, which is also what the definition in Sionna RT gives that the source of `_compute_doppler` refers to. The script
# fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'deepmimo==4.0.5' 'numpy==2.2.6'
cat > "$folder/observe.py" <<'PYTHON'
from importlib.metadata import version
from types import SimpleNamespace

import deepmimo
import numpy as np
from deepmimo.core.scene import Face, PhysicalElement

C, FREQUENCY = 299792458.0, 3e9


def outline(label, low, high, z):
    """Return an object of the scene with one face."""
    return PhysicalElement([Face([(low, low, z), (high, low, z), (high, high, z)])], label=label)


def shift(receiver, tx_velocity, rx_velocity):
    """Return the Doppler shift of the direct path from the origin [Hz], and the expected one."""
    distance = np.linalg.norm(receiver)
    direction = np.array(receiver) / distance
    departure, arrival = (
        (np.degrees(np.arctan2(v[1], v[0])), np.degrees(np.arccos(v[2])))
        for v in (direction, -direction))
    dataset = deepmimo.Dataset()
    for name, value in {'power': 0.0, 'phase': 0.0, 'delay': distance / C, 'inter': 0.0,
                        'aod_az': departure[0], 'aod_el': departure[1],
                        'aoa_az': arrival[0], 'aoa_el': arrival[1]}.items():
        setattr(dataset, name, np.array([[value]]))
    dataset.inter_pos = np.full((1, 1, 1, 3), np.nan)
    dataset.tx_pos, dataset.rx_pos = np.zeros((1, 3)), np.array([receiver], float)
    dataset.scene = deepmimo.Scene()
    dataset.scene.add_objects([outline('terrain', -50, 50, -9), outline('buildings', 40, 45, 0)])
    dataset.rt_params = SimpleNamespace(frequency=FREQUENCY)
    dataset.tx_vel, dataset.rx_vel = np.array(tx_velocity, float), np.array(rx_velocity, float)
    expected = np.dot(np.subtract(tx_velocity, rx_velocity), direction) * FREQUENCY / C
    return dataset.doppler.item(), expected


print('deepmimo', version('deepmimo'))
for axis, velocity in zip('xyz', 3 * np.eye(3)):
    for who, (found, expected) in (('transmitter', shift((3, 4, 5), velocity, np.zeros(3))),
                                   ('receiver', shift((3, 4, 5), np.zeros(3), velocity))):
        print(f'{who} moves along {axis}: {found:.1f} Hz,',
              'as expected' if np.isclose(found, expected) else f'expected {expected:.1f} Hz')
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" "$folder/observe.py" 2>"$folder/log" |
  grep -e '^deepmimo ' -e ' moves along ')
echo "$found"
[[ $found == 'deepmimo 4.0.5
transmitter moves along x: 12.7 Hz, as expected
receiver moves along x: 12.7 Hz, expected -12.7 Hz
transmitter moves along y: 17.0 Hz, as expected
receiver moves along y: -17.0 Hz, as expected
transmitter moves along z: 21.2 Hz, as expected
receiver moves along z: -21.2 Hz, as expected' ]]
