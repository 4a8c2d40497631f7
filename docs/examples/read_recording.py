"""An estimator on a recording without ROS, after ``pip install mcap-ros2-support``."""

import sys

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import make_estimator


def array(one):
    """Return a `RealArray` or a `ComplexArray` as an array."""
    values = one.data if hasattr(one, 'data') else 1j * np.array(one.im) + one.re
    return np.reshape(values, one.shape)


with open(sys.argv[1], 'rb') as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    (text,) = (one.metadata['yaml'] for one in reader.iter_metadata() if one.name == 'scenario')
    (beams, *_), truths, signals = (
        [one for *_, one in reader.iter_decoded_messages(f'/{topic}')]
        for topic in ('codebook', 'ground_truth', 'received_signals'))
codebook = Codebook(array(beams.analog), array(beams.digital))
locate = make_estimator(sys.argv[2], Scenario(**yaml.safe_load(text)), codebook).estimate
places = {one.cycle_id: one.position for one in truths}
pairs = [(array(one.signals), places[one.cycle_id]) for one in signals if one.cycle_id in places]
errors = [np.linalg.norm(locate(signal.reshape(len(signal), -1)).mean - [one.x, one.y, one.z])
          for signal, one in pairs]
print(f'{len(errors)} cycles, median error {np.nanmedian(errors):.6f} m')
