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

import numpy as np
from parts.array_receiver import ArrayReceiver, posterior_means
from parts.frame import CONFIG, Table, benchmark_parser, run, shown, write_results

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.unoptimised import SCANS
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import radiation_matrix


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
    radiation = radiation_matrix(scenario, Codebook.load(CONFIG / f'{name}.yaml'))
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
    parser = benchmark_parser('baselines', __doc__, 1000)
    parser.add_argument('--multipath', type=float, default=0.0, metavar='DB',
                        help='level of the multipath [dB]')
    options = parser.parse_args()
    scenario = Scenario(multipath_to_los_db=options.multipath)
    positions = scenario.sample_positions(
        options.positions, np.random.default_rng(options.seed))
    print(f'{options.positions} positions, seed {options.seed}, posterior mean, multipath '
          f'{options.multipath:g} dB\n')
    table = Table('receiver', 'average CRLB [m²]', 'mean squared error [m²]', 'standard error',
                  'median')
    figures = {}
    for name, make in receivers(scenario, options.seed).items():
        receiver = make()
        received = receiver.simulate(positions, np.random.default_rng(options.seed + 1))
        errors = np.sum((posterior_means(receiver, received) - positions)**2, axis=1)
        figures[name] = {
            'average_crlb_m2': receiver.crlb(positions).mean(), 'mse_m2': errors.mean(),
            'standard_error_m2': errors.std() / np.sqrt(len(errors)),
            'median_m2': np.median(errors)}
        table.row(name, *(shown(value, 4) for value in figures[name].values()))
    write_results(options.json, figures)


if __name__ == '__main__':
    run(main)
