"""Paths of Sionna RT as a channel, where the tracer runs on another machine.

On that machine, after ``paths = PathSolver()(scene)``:

    names = 'tau', 'theta_r', 'phi_r', 'valid', 'interactions', 'sources', 'targets'
    np.savez('paths.npz', a_real=paths.a[0], a_imag=paths.a[1],
             **{name: getattr(paths, name) for name in names})
"""

import sys
import types

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import PathChannel, Scenario, simulate_received

arrays = dict(np.load(sys.argv[1]))
a = arrays.pop('a_real'), arrays.pop('a_imag')
channel = PathChannel.from_sionna(types.SimpleNamespace(a=a, **arrays), f0=2.75e9)
received = simulate_received(Scenario(channel=channel), Codebook.default(), channel.users,
                             np.random.default_rng(0))
print(f'{len(channel.users)} users, {np.sum(channel.n >= 0)} paths, signals {received.shape}')
