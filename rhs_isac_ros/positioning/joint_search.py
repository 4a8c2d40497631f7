"""The search on the table for modes of the posterior of signals with unknown gain and phases.

One complex number per band and grid point, the output z_i of the matched filter, suffices: with
the amplitude A = sum_i Re(z_i) in its most likely phases, the log-likelihood at a factor h of the
signals is ``-h^2 |y|^2 + 2 h A - E + 2 n log h``, with the energy E of the template.
"""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.separation import separate
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.unknowns import Unknowns

# Number of peaks to compare, and of points on which the profile over the gain is tabulated.
_MAX_PEAKS = 768
_N_GAIN = 161
_N_AMPLITUDE = 256
_GAIN_REACH = 4.5
# Error of the log-likelihood due to the grid, as a share of the template's energy.
_GRID_ERROR = 0.08
# Peaks closer than this in (r in wavelengths, u, v) are one mode.
_MIN_SEPARATION = np.array([0.3, 0.03, 0.03])
_COARSE_RANGE_M = 0.6


class Start(NamedTuple):
    """Points (r [m], u, v) to refine, float64 [M, 3], and nuisance parameters there [M, Q]."""

    points: np.ndarray
    values: np.ndarray


def gain_profile(unknowns: Unknowns, energy: float, n_measurements: int,
                 amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maximise the log-likelihood over the gain, up to -E.

    Returns the maximum and the gain [nepers] for amplitudes A of any shape.
    """
    if unknowns.gain is None:
        return 2 * amplitude - energy, np.zeros(1)
    std = unknowns.std[unknowns.gain]
    gain = std * np.linspace(-_GAIN_REACH, _GAIN_REACH, _N_GAIN)
    factor = np.exp(-gain)
    fixed = -factor**2 * energy - 2 * n_measurements * gain - gain**2 / (2 * std**2)
    low, high = float(amplitude.min()), float(amplitude.max())
    knots = np.linspace(low, high + 1e-9 * (1 + abs(high)), _N_AMPLITUDE)
    table = fixed + 2 * factor * knots[:, None]
    best = table.argmax(axis=1)
    return (np.interp(amplitude, knots, table.max(axis=1)),
            np.interp(amplitude, knots, gain[best]))


def find_starts(
        table: TemplateTable, unknowns: Unknowns, whitened: np.ndarray, max_modes: int,
        margin: float) -> Start:
    """Find points from which refinement reaches the modes, the most likely first.

    The whitened signals are those of one positioning phase, complex128 [N_B, N_SB F].
    """
    outputs = table.band_outputs(whitened)
    coarse = unknowns.is_coarse
    offsets = np.zeros(1) if coarse else table.range_offsets_m
    amplitude = _amplitude(unknowns, outputs, table.rotations(offsets))
    energy = float(np.sum(np.abs(whitened)**2))
    profile, _ = gain_profile(unknowns, energy, whitened.size, amplitude)
    value = profile - table.energy[:, None]
    cell, fine = _peaks(value)
    order = np.argsort(-value[cell, fine])
    cell, fine = cell[order], fine[order]
    tolerance = margin + _GRID_ERROR * table.energy[cell]
    keep = value[cell, fine] >= value[cell[0], fine[0]] - np.maximum(tolerance, tolerance[0])
    cell, fine = cell[keep], fine[keep]
    points = table.points[cell].copy()
    points[:, 0] += offsets[fine]
    scale = _MIN_SEPARATION * (table.wavelength_m, 1, 1)
    if coarse:
        scale[0] = _COARSE_RANGE_M
    chosen = separate(points / scale, max_modes)
    cell, fine = cell[chosen], fine[chosen]
    rotated = outputs[:, cell] * table.rotations(offsets)[:, fine]
    values = np.zeros((len(chosen), len(unknowns.names)))
    _set_phases(unknowns, rotated, values)
    if unknowns.gain is not None:
        values[:, unknowns.gain] = gain_profile(
            unknowns, energy, whitened.size, amplitude[cell, fine])[1]
    return Start(points[chosen], values)


def _amplitude(unknowns: Unknowns, outputs: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Amplitude A in the most likely phases, float64 [G, D].

    Takes the filters' outputs [N_B, G] and rotations over fine ranges [N_B, D].
    """
    rotated = outputs[:, :, None] * rotations[:, None]
    if unknowns.band_phase_std_rad:
        std = float(np.hypot(unknowns.band_phase_std_rad, unknowns.phase_std_rad))
        amplitude: np.ndarray = _in_phase(rotated, std).sum(axis=0)
    elif unknowns.phase_std_rad:
        amplitude = _in_phase(rotated.sum(axis=0), unknowns.phase_std_rad)
    else:
        amplitude = rotated.sum(axis=0).real
    return amplitude


def _in_phase(outputs: np.ndarray, std: float) -> np.ndarray:
    """Real part of outputs after the most likely rotation, less half its prior cost."""
    magnitude: np.ndarray = np.abs(outputs)
    if not np.isfinite(std):
        return magnitude
    angle = np.angle(outputs)
    phase = angle * magnitude / (magnitude + 1 / (2 * std**2))
    value: np.ndarray = magnitude * np.cos(angle - phase) - phase**2 / (4 * std**2)
    return value


def _set_phases(unknowns: Unknowns, outputs: np.ndarray, values: np.ndarray) -> None:
    """Fill in the most likely phases, for filters' outputs [N_B, M]."""
    band = 0
    common = np.angle(outputs.sum(axis=0))
    std = np.hypot(unknowns.band_phase_std_rad, unknowns.phase_std_rad)
    for q, name in enumerate(unknowns.names):
        if name == 'band_phase':
            share = (1.0 if not np.isfinite(std)
                     else (unknowns.band_phase_std_rad / std)**2)
            values[:, q] = share * np.angle(outputs[band])
            band += 1
        elif name == 'phase':
            values[:, q] = 0.0 if unknowns.band_phase_std_rad else common


def _peaks(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cell and fine range of the highest peaks along the range."""
    peak = np.ones(value.shape, bool)
    peak[:, 1:] &= value[:, 1:] >= value[:, :-1]
    peak[:, :-1] &= value[:, :-1] >= value[:, 1:]
    cell, fine = np.nonzero(peak)
    if len(cell) > _MAX_PEAKS:
        best = np.argpartition(value[cell, fine], -_MAX_PEAKS)[-_MAX_PEAKS:]
        cell, fine = cell[best], fine[best]
    return cell, fine
