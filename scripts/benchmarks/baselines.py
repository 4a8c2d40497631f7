"""Positioning error of the surface beside that of other receivers, from the same pilots.

Problem: the surface has K feeds and observes all its elements through them. How much accuracy
does that cost, compared with more expensive receivers? All of them receive the same pilots, N_SB
sub-bands in F frames of N_B bands, from the same positions:

* all elements: the signal of every element in every frame, whose error bounds all codebooks;
* fully digital: K antennas at corners of the surface;
* phased array: a single radio-frequency chain or K of them, each with a phase shifter for every
  element. The phases are random, or matched to points that scan the region, as for the directional
  codebook.

Every weight of an element has the modulus sqrt(P_max / N_SB). Like the paper's propagation on the
board, this does not conserve energy; it gives all receivers the same thermal noise for each
element. The estimator is the posterior mean. The receiver with all elements averages its outputs
over the frames. This is exact except for the decorrelation of the multipath between the frames.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.bounds.fisher import inverse_information
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.unoptimised import SCANS
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.model.los import los_and_derivative, los_gain
from rhs_isac_ros.model.multipath import (
    complex_normal,
    measurement_correlation,
    multipath_covariance,
)
from rhs_isac_ros.model.surface import AppliedBeams, radiation_matrix
from rhs_isac_ros.positioning.grid import TemplateTable
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.positioning.likelihood import Factors, Likelihood, Signals
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.posterior import draw_samples
from rhs_isac_ros.positioning.search import find_modes
from rhs_isac_ros.positioning.templates import tabulate

# Positions whose mean signals determine the subspace of all mean signals, and its accuracy: the
# largest whitened amplitude outside of it.
_N_SUBSPACE, _TOLERANCE = 2000, 1e-3
_BLOCK = 128


def _slopes(scenario: Scenario, positions: np.ndarray, band: int) -> np.ndarray:
    return los_and_derivative(scenario, positions, band)[1]


class ArrayReceiver:
    """Whitened signals of a receiver, reduced to the subspace of its mean signals.

    The reduction keeps everything that the signals contain about the position. It has the
    interface of `MeasurementModel` that the search for modes needs.

    Parameters
    ----------
    weights
        Weights of the elements in the M outputs of every sub-band, complex128
        [N_B, N_SB or 1, M, N_E] [sqrt(W)].
    frames
        Frame of each output, int [M].
    averaged
        Number of frames over which each output is averaged, which divides the power of the noise.
    """

    def __init__(self, scenario: Scenario, weights: np.ndarray, frames: np.ndarray,
                 averaged: int = 1) -> None:
        # The outputs combine the sub-bands, so that the search sees one with the same width.
        self._scenario, self.scenario = scenario, dataclasses.replace(
            scenario, n_subbands=1,
            subband_width_hz=scenario.n_subbands * scenario.subband_width_hz)
        n_elements, n_rows = scenario.n_elements, scenario.n_subbands * len(frames)
        weights = np.broadcast_to(weights, (
            scenario.n_bands, scenario.n_subbands, len(frames), n_elements))
        rows = (np.arange(scenario.n_subbands)[:, None] * scenario.n_frames + frames).ravel()
        whiteners = []
        for band, (spatial, correlation) in enumerate(zip(
                multipath_covariance(scenario), measurement_correlation(scenario), strict=True)):
            radiation = weights[band].reshape(n_rows, n_elements)
            covariance = correlation[np.ix_(rows, rows)] * (
                radiation @ spatial @ radiation.conj().T)
            covariance += scenario.noise_power_w / averaged * np.eye(n_rows)
            whiteners.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        # Whitened response to the gains of the elements, [N_SB N_E, rows] for each band.
        self._responses = [self._response(scenario, whitener, weights[band])
                           for band, whitener in enumerate(whiteners)]
        positions = scenario.sample_positions(_N_SUBSPACE, np.random.default_rng(0))
        bases = [np.linalg.svd(
            self._gains(los_gain, positions, band) @ response, full_matrices=False)[1:]
            for band, response in enumerate(self._responses)]
        rank = max(int(np.sum(values > _TOLERANCE)) for values, _ in bases)
        self._responses = [response @ basis[:rank].conj().T for response, (_, basis) in zip(
            self._responses, bases, strict=True)]
        self.shape = len(whiteners), min(rank, *(len(basis) for _, basis in bases))
        # The signals are white.
        self.whitener = np.tile(np.eye(self.shape[1]), (len(whiteners), 1, 1))

    @staticmethod
    def _response(scenario: Scenario, whitener: np.ndarray, weights: np.ndarray) -> np.ndarray:
        by_subband = whitener.reshape(len(whitener), scenario.n_subbands, -1)
        return np.einsum('rjm,jme->jer', by_subband, weights).reshape(-1, len(whitener))

    def _gains(self, function: Callable[[Scenario, np.ndarray, int], np.ndarray],
               positions: np.ndarray, band: int) -> np.ndarray:
        gains = function(self._scenario, positions, band)
        return gains.reshape(*gains.shape[:-2], -1)

    def mean(self, positions: np.ndarray) -> np.ndarray:
        """Compute mean signals, complex128 [N, N_B, r], at positions [N, 3] [m]."""
        return np.stack([self._gains(los_gain, positions, band) @ response
                         for band, response in enumerate(self._responses)], axis=1)

    def mean_and_jacobian(
            self, positions: np.ndarray, by_coordinate: np.ndarray | None = None, *,
            whitened: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Compute mean signals and their derivative, [N, N_B, r] and [N, 3, N_B, r] [1/m].

        The signals are white in any case; `by_coordinate` is as in `MeasurementModel`.
        """
        jacobian = np.stack(
            [self._gains(_slopes, positions, band) @ response
             for band, response in enumerate(self._responses)], axis=2)
        if by_coordinate is not None:
            jacobian = np.einsum('nxq,nx...->nq...', by_coordinate, jacobian)
        return self.mean(positions), jacobian

    def crlb(self, positions: np.ndarray) -> np.ndarray:
        """Compute the Cramer-Rao bound at positions, float64 [N] [m^2]."""
        bounds = []
        for start in range(0, len(positions), _BLOCK):
            _, slopes = self.mean_and_jacobian(positions[start:start + _BLOCK])
            information = quadratic_form(slopes)
            bounds.append(np.trace(inverse_information(information), axis1=1, axis2=2))
        return np.concatenate(bounds)

    def simulate(self, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw signals of independent positioning phases, complex128 [N, N_B, r]."""
        means = np.concatenate([self.mean(positions[start:start + _BLOCK])
                                for start in range(0, len(positions), _BLOCK)])
        return means + complex_normal(means.shape, rng)


class ArrayLikelihood(Likelihood):
    """The likelihood of a receiver's signals, which are white, without impairments."""

    def __init__(self, receiver: ArrayReceiver) -> None:
        self.scenario = scenario = receiver.scenario
        self.model = receiver
        dark = AppliedBeams(
            np.zeros((scenario.n_bands, scenario.n_frames, scenario.n_elements)),
            np.zeros((scenario.n_bands, scenario.n_subbands, scenario.n_frames,
                      scenario.n_feeds)))
        # The prior of no parameters is the same for all beams.
        self.nuisance = NuisancePrior(MeasurementModel(scenario, dark))
        self.nuisance.scaled_patterns = np.zeros((0, *receiver.shape))
        # The factor of a white covariance is its own inverse.
        self.factors = Factors.of_roots(self.nuisance, receiver.whitener)
        self.log_det = float(np.sum(self.factors.log_det))
        self.resolution = Resolution.of(scenario)


def posterior_means(receiver: ArrayReceiver, received: np.ndarray) -> np.ndarray:
    """Compute the posterior means of positioning phases as `bayes` does, float64 [N, 3] [m].

    Every mode of the likelihood contributes with the mass of its Gaussian inside the region.
    """
    likelihood = ArrayLikelihood(receiver)
    grid = TemplateTable(receiver.scenario, tabulate(receiver, prior=likelihood.nuisance))
    means = []
    for start in range(0, len(received), _BLOCK):
        signals = received[start:start + _BLOCK]
        modes = find_modes(
            likelihood, grid, Signals(signals, signals), np.zeros((len(signals), 0)))
        samples = draw_samples(modes, grid.normal, receiver.scenario.roi_bounds_m)
        means.append(samples.moments()[0])
    return np.concatenate(means)


def all_elements(scenario: Scenario) -> ArrayReceiver:
    """Observe every element in every frame."""
    weights = amplitude(scenario) * np.eye(scenario.n_elements, dtype=complex)
    return ArrayReceiver(
        scenario, weights, np.zeros(scenario.n_elements, int), scenario.n_frames)


def fully_digital(scenario: Scenario) -> ArrayReceiver:
    """Observe K elements in every frame, starting with three corners of the surface."""
    last = scenario.n_elements - 1
    corners = [0, scenario.n_columns - 1, last + 1 - scenario.n_columns, last]
    others = [m for m in range(scenario.n_elements) if m not in corners]
    chosen = np.eye(scenario.n_elements, dtype=complex)[[*corners, *others][:scenario.n_feeds]]
    return ArrayReceiver(scenario, amplitude(scenario) * chosen, np.zeros(len(chosen), int),
                         scenario.n_frames)


def phased_array(scenario: Scenario, chains: int, rng: np.random.Generator | None
) -> ArrayReceiver:
    """Form beams with phase shifters; random phases with `rng`, or else a scan of the region."""
    frames = np.repeat(np.arange(scenario.n_frames), chains)
    if rng is not None:
        phases = rng.uniform(0, 2 * np.pi, (scenario.n_bands, len(frames), scenario.n_elements))
    else:
        points = SCANS['width'](dataclasses.replace(scenario, n_frames=len(frames)))
        middle = scenario.n_subbands // 2
        phases = -np.stack([np.angle(los_gain(scenario, points[:, band], band)[:, middle])
                            for band in range(scenario.n_bands)])
    return ArrayReceiver(scenario, amplitude(scenario) * np.exp(1j * phases)[:, None], frames)


def surface(scenario: Scenario, name: str) -> ArrayReceiver:
    """Observe the elements through the surface with a codebook of config/."""
    radiation = radiation_matrix(scenario, Codebook.load(frame.CONFIG / f'{name}.yaml'))
    shape = scenario.n_bands, scenario.n_subbands, scenario.n_frames, scenario.n_elements
    return ArrayReceiver(scenario, radiation.reshape(shape), np.arange(scenario.n_frames))


def amplitude(scenario: Scenario) -> float:
    """Return the modulus of every weight [sqrt(W)]."""
    return float(np.sqrt(scenario.max_power_w / scenario.n_subbands))


def receivers(scenario: Scenario, seed: int) -> dict[str, Callable[[], ArrayReceiver]]:
    """Return the functions that make the receivers, by name."""
    chains = scenario.n_feeds

    def shifters(n: int, random: bool) -> Callable[[], ArrayReceiver]:
        return lambda: phased_array(
            scenario, n, np.random.default_rng(seed) if random else None)

    return {
        'all elements': lambda: all_elements(scenario),
        'surface, default codebook': lambda: surface(scenario, 'codebook'),
        'surface, CRLB codebook': lambda: surface(scenario, 'codebook_crlb'),
        f'fully digital, {chains} antennas': lambda: fully_digital(scenario),
        f'phased array, {chains} chains, random': shifters(chains, True),
        f'phased array, {chains} chains, scan': shifters(chains, False),
        'phased array, 1 chain, random': shifters(1, True),
        'phased array, 1 chain, scan': shifters(1, False)}


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('baselines', __doc__, 1000, has_jobs=True).parse_args()
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    figures = frame.measured(options, 'baselines', measure, {
        name: {'name': name, 'n': options.positions, 'seed': options.seed}
        for name in receivers(Scenario(), options.seed)})
    table = frame.Table(['receiver'], {
        'average CRLB [m²]': ('average_crlb_m2', 4), 'mean squared error [m²]': ('mse_m2', 4),
        'standard error': ('standard_error_m2', 4), 'median': ('median_m2', 4)})
    for name, row in figures.items():
        table.row(name, **row)
    frame.write_results(options.json, figures)


def measure(name: str, n: int, seed: int) -> dict[str, Any]:
    """Run a job: locate users with a receiver."""
    scenario = Scenario()
    positions = scenario.sample_positions(n, np.random.default_rng(seed))
    receiver = receivers(scenario, seed)[name]()
    received = receiver.simulate(positions, np.random.default_rng(seed + 1))
    errors = np.sum((posterior_means(receiver, received) - positions)**2, axis=1)
    return {'average_crlb_m2': receiver.crlb(positions).mean(), 'mse_m2': errors.mean(),
            'standard_error_m2': errors.std() / np.sqrt(len(errors)),
            'median_m2': np.median(errors)}


if __name__ == '__main__':
    frame.run(main)
