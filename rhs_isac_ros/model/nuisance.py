"""Nuisance parameters: unknown factors of the received signals besides the position.

Every nuisance parameter is a factor ``exp(value * pattern)`` of all signals of a phase, where the
pattern is 1 for a gain in nepers and imaginary for a phase. The factor applies to the direct path
and to the multipath, but not to the thermal noise. Values are Gaussian with zero mean and
independent; the exponential wraps those of phases.
"""

import dataclasses
import functools

import numpy as np

from rhs_isac_ros.model.geometry import subband_frequencies_hz
from rhs_isac_ros.model.scenario import Scenario

# Nepers per decibel of an amplitude gain.
_NEPERS_PER_DB = np.log(10) / 20


@dataclasses.dataclass(frozen=True)
class NuisanceParameter:
    """A nuisance parameter.

    Attributes
    ----------
    name
        ``gain``, ``phase``, ``band_phase``, ``timing`` or ``carrier_offset``.
    unit
        Unit of its values: ``1`` for nepers, ``rad``, ``s`` or ``Hz``.
    std
        Standard deviation of its values, positive.
    band
        The only band that it affects, from 0; None if it affects all bands.
    per_user
        Whether the value belongs to a user; otherwise, each cycle has a new one.
    """

    name: str
    unit: str
    std: float
    band: int | None = None
    per_user: bool = False


def nuisance_parameters(scenario: Scenario) -> tuple[NuisanceParameter, ...]:
    """Return the Q nuisance parameters that a scenario declares; none for Table I."""
    return tuple(parameter for parameter in _candidates(scenario) if parameter.std > 0)


@functools.lru_cache(maxsize=16)
def nuisance_patterns(scenario: Scenario) -> np.ndarray:
    """Compute the patterns of `nuisance_parameters`, complex128 [Q, N_B, N_SB F], read-only.

    Gain: 1. Phase: i. Phase of a band: i in this band, else 0. Timing offset:
    -2 pi i (f_{i,j} - f_c,i). Carrier offset: 2 pi i q T_F in frame q, from 0.
    """
    patterns = _all_patterns(scenario)
    declared = [parameter.std > 0 for parameter in _candidates(scenario)]
    chosen: np.ndarray = patterns[declared]
    chosen.flags.writeable = False
    return chosen


def nuisance_directions(scenario: Scenario, mean: np.ndarray) -> np.ndarray:
    """Compute the derivative of mean signals with respect to the nuisance parameters at zero.

    Takes mean signals, complex128 [N, N_B, N_SB F]; returns complex128 [N, Q, N_B, N_SB F], in
    units of the signals per unit of the parameter.
    """
    directions: np.ndarray = nuisance_patterns(scenario) * mean[:, None]
    return directions


def nuisance_factors(scenario: Scenario, values: np.ndarray) -> np.ndarray:
    """Compute the factors of the signals for values of the nuisance parameters.

    Takes float64 [N, Q], in the order and units of `nuisance_parameters`; returns complex128
    [N, N_B, N_SB F].

    Raises
    ------
    ValueError
        If there is not one value for each parameter.
    """
    patterns = nuisance_patterns(scenario)
    if np.ndim(values) != 2 or np.shape(values)[1] != len(patterns):
        raise ValueError(f'values: shape {np.shape(values)}, expected [N, Q] with Q = '
                         f'{len(patterns)}')
    factors: np.ndarray = np.exp(np.tensordot(values, patterns, axes=1))
    return factors


def draw_nuisance(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw values of the nuisance parameters for n independent users and cycles, float64 [n, Q].

    The values of a parameter do not depend on which other parameters the scenario declares.
    """
    user, cycle = _white(scenario, n, rng, rng)
    return _values(scenario, user, cycle)


def draw_user_cycle(
        scenario: Scenario, user: np.random.Generator, cycle: np.random.Generator) -> np.ndarray:
    """Draw values for one cycle of one user, float64 [1, Q], from a generator for each."""
    return _values(scenario, *_white(scenario, 1, user, cycle))


def _candidates(scenario: Scenario) -> tuple[NuisanceParameter, ...]:
    """All parameters that a scenario can declare, those of users first."""
    return (
        NuisanceParameter(
            'gain', '1', scenario.user_gain_std_db * _NEPERS_PER_DB, per_user=True),
        NuisanceParameter(
            'carrier_offset', 'Hz', scenario.carrier_offset_std_hz, per_user=True),
        NuisanceParameter('phase', 'rad', scenario.phase_std_rad),
        NuisanceParameter('timing', 's', scenario.timing_std_s),
        *(NuisanceParameter('band_phase', 'rad', scenario.band_phase_std_rad, band)
          for band in range(scenario.n_bands)))


def _all_patterns(scenario: Scenario) -> np.ndarray:
    """Patterns of `_candidates`, complex128 [P, N_B, N_SB F]."""
    n_bands, n_frames = scenario.n_bands, scenario.n_frames
    shape = n_bands, scenario.n_subbands, n_frames
    centers = np.array(scenario.center_frequencies_hz)[:, None]
    offsets = subband_frequencies_hz(scenario) - centers
    frames = np.arange(n_frames) * scenario.frame_duration_s
    candidates = _candidates(scenario)
    patterns = np.zeros((len(candidates), *shape), complex)
    for pattern, parameter in zip(patterns, candidates, strict=True):
        match parameter.name:
            case 'gain':
                pattern[:] = 1.0
            case 'carrier_offset':
                pattern[:] = 2j * np.pi * frames
            case 'phase':
                pattern[:] = 1j
            case 'timing':
                pattern[:] = -2j * np.pi * offsets[..., None]
            case _:
                pattern[parameter.band] = 1j
    return patterns.reshape(len(candidates), n_bands, -1)


def _white(scenario: Scenario, n: int, user: np.random.Generator,
           cycle: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal numbers for the candidates of users and of cycles, [n, 2] and [n, ...]."""
    return user.standard_normal((n, 2)), cycle.standard_normal((n, 2 + scenario.n_bands))


def _values(scenario: Scenario, user: np.ndarray, cycle: np.ndarray) -> np.ndarray:
    std = np.array([parameter.std for parameter in _candidates(scenario)])
    values: np.ndarray = (np.concatenate([user, cycle], axis=1) * std)[:, std > 0]
    return values
