"""Signals of many measurements, projected onto the few dimensions that their means fill.

Over the region of interest, whitened means fill few dimensions, whatever the number of
measurements. The likelihood of the signals projected onto an orthonormal basis of these dimensions
is the likelihood of all signals, but for a factor that does not depend on the position. The basis
lacks less than `MAX_LOSS` of the energy of the means. The energy of the signals outside of the
basis becomes one more number, whose mean is 0; residual energies are then those of all signals.

Between sub-bands, the gains of the elements are interpolated from those at few frequencies,
because the delays of the region are short. The projected signals are those of a scenario with
these frequencies as its sub-bands, and the dimensions as its frames; the whitener adds up the
sub-bands.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, MeasurementModel, Scenario, geometry
from rhs_isac_ros.model.arrays import adjoint, multiply_rows
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.support import streams

# Number of measurements of a band up to which the projection costs more than it saves.
_FEW = 128
#: Mean energy of whitened means outside of the basis: a loss of log-likelihood [nats].
MAX_LOSS = 1e-8
# Usual error of interpolated gains; share of the largest singular value
# that is zero up to rounding; and number of delays at which the error is minimised, with further
# ones for each turn of the phase over the band.
_MAX_ERROR, _SINGULAR, _DELAYS, _DELAYS_PER_TURN = 1e-9, 1e-13, 40, 6


class ProjectedModel(MeasurementModel):
    """Distribution of the projected signals of a model.

    Parameters
    ----------
    basis
        Orthonormal basis of whitened means, complex128 [N_B, n, d].
    ends_m
        Smallest and largest distance of a user; by default, those of the region of interest.
    max_error
        Largest error of interpolated gains, relative to the gain.
    """

    def __init__(self, full: MeasurementModel, basis: np.ndarray,
                 ends_m: np.ndarray | None = None, max_error: float = _MAX_ERROR) -> None:
        self.full, self.basis = full, basis
        self.beams, self.surface, self.elements = full.beams, full.surface, full.elements
        n_bands, _, n_dimensions = basis.shape
        # One more dimension is for the energy outside of the basis.
        n_columns = n_dimensions + 1
        weights = interpolation(full.scenario, ends_m, max_error)
        n_nodes = weights.shape[1]
        # The whitening contains the multipath; a measured one would not fit other sub-bands.
        self.scenario = dataclasses.replace(
            full.scenario, n_subbands=n_nodes, n_frames=n_columns, multipath=None,
            subband_spacing_hz=full.scenario.bandwidth_hz / n_nodes)
        unit = np.tile(np.eye(n_columns, dtype=complex), (n_bands, 1, 1))
        self.combined_root = self.combined_whitener = unit
        self.whitener = np.tile(unit, (1, 1, n_nodes))
        self.root = np.swapaxes(self.whitener, 1, 2) / n_nodes
        projector = adjoint(full.expand(adjoint(full.combined_whitener) @ basis))
        frames = full.radiation.reshape(*full.radiation.shape[:1], len(weights), -1)
        frames = frames / geometry.subband_frequencies_hz(full.scenario)[..., None]
        frequencies = geometry.subband_frequencies_hz(self.scenario)
        radiation = np.zeros((n_bands, n_nodes, n_columns, full.scenario.n_elements), complex)
        for node, column in enumerate(weights.T):
            rows = (frames * column[:, None]).reshape(full.radiation.shape)
            radiation[:, node, :-1] = frequencies[:, node, None, None] * (projector @ rows)
        self.radiation = radiation.reshape(n_bands, -1, full.scenario.n_elements)

    @property
    def n_whitened(self) -> int:
        """Number of whitened signals of all bands before the projection."""
        return self.full.n_whitened

    def combine(self, signals: np.ndarray) -> np.ndarray:
        """Combine sub-bands; see `MeasurementModel.combine`."""
        return self.full.combine(signals)

    def whiten(self, signals: np.ndarray) -> np.ndarray:
        """Whiten signals [..., N_B, N_SB F] of the full model and project them."""
        return project(self.basis, self.full.whiten(signals))

    def _whitened_terms(self, terms: np.ndarray) -> np.ndarray:
        return terms.reshape(
            *terms.shape[:-1], -1, self.whitener.shape[1]).sum(axis=-2)


def project(basis: np.ndarray, whitened: np.ndarray) -> np.ndarray:
    """Project signals [..., N_B, n] onto a basis [N_B, n, d]; append the root of the rest."""
    inside = multiply_rows(adjoint(basis), whitened)
    energies = [np.sum(np.abs(one)**2, axis=-1) for one in (whitened, inside)]
    rest = np.sqrt(np.maximum(energies[0] - energies[1], 0.0))
    return np.concatenate([inside, rest[..., None]], axis=-1)


def projected(model: MeasurementModel) -> MeasurementModel:
    """Project the signals of a model if they are many, and else return it.

    Parameters that act differently on the measurements of a band, unknown gains and errors of the
    elements change the whitening, and prevent it.
    """
    nuisance = nuisance_of(model.scenario)
    n_bands = model.scenario.n_bands
    if (not model.elements.is_exact or nuisance.has_gain or nuisance.moves_multipath.any()
            or model.scenario.user_speed_std_mps or model.n_whitened <= _FEW * n_bands):
        return model
    low, high = model.scenario.roi_bounds_m
    means = white_means(model, low + (high - low) * streams.unit_points())
    return ProjectedModel(model, basis_of([means]))


def at_ranges(model: MeasurementModel, ranges_m: np.ndarray, points: np.ndarray, max_error: float
              ) -> list[ProjectedModel]:
    """Return a model for each range [m], whose gains have errors up to `max_error`.

    The basis is that of a model that is projected, for users at points (r [m], u, v), [M, 3], or
    contains all whitened signals.
    """
    full, basis = model, np.tile(np.eye(model.combined_root.shape[1]), (model.shape[0], 1, 1))
    if isinstance(model, ProjectedModel):
        few = points[::-(-len(points) // len(streams.unit_points()))]
        full = model.full
        basis = basis_of([white_means(full, geometry.to_positions(few))])
    return [ProjectedModel(full, basis, np.full(2, range_m), max_error)
            for range_m in ranges_m.tolist()]


def white_means(model: MeasurementModel, positions: np.ndarray) -> np.ndarray:
    """Compute whitened means at positions [N, 3] [m], complex128 [N_B, N, n]."""
    means, _ = model.mean_and_jacobian(
        positions, np.zeros((len(positions), 3, 0)), whitened=True)
    return np.swapaxes(means, 0, 1)


def basis_of(samples: Sequence[np.ndarray]) -> np.ndarray:
    """Return an orthonormal basis of whitened means, complex128 [N_B, n, d].

    The samples [N_B, M, n] cover the region, and whatever else changes the mean.
    """
    spread = np.sum(
        [np.swapaxes(one, 1, 2) @ one.conj() / one.shape[1] for one in samples], axis=0)
    energies, vectors = np.linalg.eigh(spread)
    lost = np.cumsum(energies, axis=1)
    n_dimensions = int(np.count_nonzero(lost > MAX_LOSS, axis=1).max())
    return vectors[:, :, -n_dimensions:]


def interpolation(scenario: Scenario, ends_m: np.ndarray | None = None,
                  max_error: float = _MAX_ERROR) -> np.ndarray:
    """Return weights [N_SB, Q] that interpolate gains from Q equally spaced frequencies.

    They hold for users at distances between `ends_m`, by default in the region of interest.
    """
    edge_m = np.linalg.norm(geometry.element_positions(scenario), axis=1).max()
    if ends_m is None:
        ends_m = geometry.polar_bounds(scenario.roi_bounds_m)[:, 0]
    delays = (ends_m + [-edge_m, edge_m]) / SPEED_OF_LIGHT_MPS
    offsets_hz = (geometry.subband_frequencies_hz(scenario) - scenario.center_frequencies_hz[0])[0]
    turns = np.ptp(offsets_hz) * np.ptp(delays)
    n_delays = _DELAYS + int(_DELAYS_PER_TURN * turns)
    # The error is largest at the ends of the interval.
    nodes_s = np.cos(np.pi * (np.arange(n_delays) + 0.5) / n_delays) * np.ptp(delays) / 2
    gains = np.exp(-2j * np.pi * np.multiply.outer(nodes_s, offsets_hz))
    for n_nodes in range(1 + int(turns), scenario.n_subbands + 1):
        # As sub-bands of a scenario, the nodes have the bandwidth of the sub-bands, and therefore
        # the same grids.
        nodes_hz = ((np.arange(n_nodes) + 0.5) / n_nodes - 0.5) * scenario.bandwidth_hz
        at_nodes = np.exp(-2j * np.pi * np.multiply.outer(nodes_s, nodes_hz))
        weights = np.linalg.lstsq(at_nodes, gains, rcond=_SINGULAR)[0]
        if np.abs(at_nodes @ weights - gains).max() <= max_error:
            break
    # The mean delay turns the gains from a node to a sub-band.
    return weights.T * np.exp(
        -1j * np.pi * delays.sum() * (offsets_hz[:, None] - nodes_hz))
