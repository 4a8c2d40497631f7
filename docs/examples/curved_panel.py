"""A curved panel: positions and normals of elements with a gain pattern."""

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario


def patch(angles):
    """Return the amplitude gain of a patch antenna, which radiates only to its front."""
    return 2 * np.maximum(np.cos(angles), 0)


angle, z = (each.ravel() for each in np.meshgrid(
    np.linspace(-0.7, 0.7, 10), np.linspace(-0.135, 0.135, 10)))
normals = np.stack([np.cos(angle), np.sin(angle), 0 * z], axis=1)
positions = 0.2 * (normals - [1, 0, 0]) + z[:, None] * [0, 0, 1]
users = np.array([[6.0, y, 0.0] for y in (-4.5, 0.0, 4.5)])
for turned in (None, normals):
    panel = Scenario(element_positions_m=positions, element_normals=turned, element_gain=patch)
    codebook = random_codebook(panel, np.random.default_rng(0))
    print(np.sqrt(crlb(panel, codebook, users)))
