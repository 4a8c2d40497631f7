"""The range ambiguity functions of Table I and of the shipped band plan."""

import numpy as np
from matplotlib import pyplot

from rhs_isac_ros.codebook import default_codebook_file
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario

lags = np.linspace(0, 6, 12000)
plans = {
    'Table I': Scenario(),
    'config/bandplan.yaml': Scenario.from_yaml(
        default_codebook_file().parent / 'bandplan.yaml')}
figure, axes = pyplot.subplots(
    len(plans), figsize=(8, 4), sharex=True, sharey=True, layout='constrained')
for axis, (name, scenario) in zip(axes, plans.items(), strict=True):
    frequencies = np.array(scenario.center_frequencies_hz)
    turns = np.multiply.outer(lags, frequencies) / SPEED_OF_LIGHT_MPS
    axis.plot(lags, np.mean(1 - np.cos(2 * np.pi * turns), axis=1), lw=0.6)
    bands = ', '.join(f'{frequency / 1e9:g}' for frequency in frequencies)
    axis.set(title=f'{name}: {bands} GHz', ylabel='mismatch', xlim=(0, 6), ylim=(0, 2))
axes[-1].set_xlabel('difference of the ranges [m]')
