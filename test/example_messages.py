"""Valid messages of each class of the protocol."""

import dataclasses
import enum
import types
from typing import Any

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m

FIXED_PLACE = np.array([8.0, -2.0, 0.5])
# Means of the mixture in an example of a posterior [m].
PLACES_OF_MODES = np.array([FIXED_PLACE, [8.0, -2.5, 0.5]])


def example_message(
        scenario: Scenario, kind: type[m.Message], rng: np.random.Generator | None = None,
        **given: Any) -> m.Message:
    """Return a valid message of a class with zeros or random numbers, or given values.

    Positions are in front of the surface, symbols have unit magnitude, and beams little power.
    """
    sizes, values = scenario.sizes, {}
    if kind is m.GroundTruths:
        given = {'users': np.array([1, 2])} | given
    if kind is m.Posterior:
        given = {'log_weights': np.log([0.25, 0.75]), 'means': PLACES_OF_MODES.copy(),
                 'covariances_m2': 0.01 * np.stack([np.eye(3), 4 * np.eye(3)]),
                 'missing_probability': 1e-3, 'outside_probability': 0.25,
                 'blocked_probability': 0.0,
                 'surface_quaternion': np.array([0.6, 0.0, 0.0, 0.8]),
                 'surface_uncertainty': 1e-4 * np.eye(6), 'sheet_log_weights': np.zeros(1),
                 'sheet_means': np.array([[8.0, -0.25, 0.0]]),
                 'sheet_covariances': 1e-4 * np.eye(3)[None],
                 'outside_log_weights': np.zeros(1), 'outside_means': np.array([[18.0, 2.0, 0.5]]),
                 'outside_covariances_m2': np.eye(3)[None], 'outside_range_m': 30.0} | given
    fields = dataclasses.fields(kind)
    for field in fields:
        meta = field.metadata
        if 'equals' in meta:
            values[field.name] = sizes[meta['equals']]
        elif 'index_of' in meta:
            size = sizes[meta['index_of']]
            values[field.name] = 0 if rng is None else int(rng.integers(size))
        elif issubclass(field.type, enum.Enum):
            members = list(field.type)
            values[field.name] = members[0 if rng is None else rng.integers(len(members))]
        elif field.type is str:
            values[field.name] = ''
        elif field.type in (int, float):
            low, high = (meta['declared'].low, meta['declared'].high) if 'declared' in meta else (
                0, np.inf)
            values[field.name] = field.type(
                low if rng is None else min(rng.integers(1, 4), high))
    values |= given
    sizes |= kind.own_sizes(types.SimpleNamespace(**values), sizes)
    for field in fields:
        if 'dims' in field.metadata and field.name not in given:
            shape = [sizes[d] if d in sizes else int(d) for d in field.metadata['dims']]
            values[field.name] = np.zeros(shape, field.metadata['declared'].kind)
            if rng is not None:
                values[field.name] += rng.random(shape)
            if field.metadata['in_front']:
                values[field.name][..., 0] += 1
            if field.name == 'symbols':
                values[field.name] = np.exp(1j * values[field.name])
            if kind is m.Beam and field.name == 'digital':
                values[field.name] *= (scenario.max_power_w / np.prod(shape))**0.5
    return kind(**values)
