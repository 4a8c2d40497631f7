"""Positioning error with each radio of the front end, and with two free clocks.

Problem: how much accuracy do pilots as samples cost, whose start, carrier and noise are unknown,
in place of sub-bands that are measured directly with equal noise? If the clocks of user and front
end differ, the carrier turns the phase from frame to frame, and the delay grows. How much of this
does the modem correct, which estimates the drift from the repeated symbols? Each position is one
cycle of the role `channel` in config/lab.yaml, with the states of the elements in lab_states.npz.
Brackets contain 95 % intervals.
"""

import functools

import numpy as np
from parts import frame
from parts.emulated_cycle import EmulatedLink

from rhs_isac_ros.calibration.calibration import load_surface
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.frontend import Air, EmulatedRadio, Radio, Waveform, WaveformRadio
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.arguments import nonnegative_float


class Uncorrected(Waveform):
    """The modem without the times of the frames."""

    def receive(self, *arguments) -> np.ndarray:
        """Return the signals of a band, with the drift of the clocks."""
        *others, times_s = arguments
        return super().receive(*others, np.zeros_like(times_s))


def free_clocks(scenario: Scenario, air: Air, clock_ppm: float, corrects: bool) -> Radio:
    """Create a radio whose clock is not that of the user."""
    radio = WaveformRadio(scenario, air, clock_ppm=clock_ppm)
    if not corrects:
        radio.modem = Uncorrected(scenario)
    return radio


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('radio', __doc__, 2000)
    parser.add_argument('--clock-ppm', type=nonnegative_float, action='append', default=[],
                        help='difference of the clocks; may be repeated')
    options = parser.parse_args()
    scenario = Scenario.from_yaml(frame.CONFIG / 'lab.yaml')
    codebook = Codebook.load(frame.CONFIG / 'codebook_lab.yaml')
    states = load_surface(str(frame.CONFIG / 'lab_states.npz'), scenario)
    radios = {'emulated': EmulatedRadio, 'waveform': WaveformRadio}
    for ppm in options.clock_ppm:
        for name, corrects in (('not corrected', False), ('corrected', True)):
            radios[f'waveform, {ppm:g} ppm {name}'] = functools.partial(
                free_clocks, clock_ppm=ppm, corrects=corrects)
    print(f'{options.positions} positions, seed {options.seed}\n')
    table = frame.Table(['radio'], {
        'mean squared error [m²]': ('mse_m2', 3), 'median error [m]': ('median_m', 3),
        'without fix [%]': ('without_fix', 1), 'in the 95 % region [%]': ('covered', 1)})
    positions = scenario.sample_positions(
        options.positions, np.random.default_rng(options.seed))
    estimator = make_estimator('bayes', scenario, codebook, surface=states)
    figures = {}
    for name, make in radios.items():
        link = EmulatedLink(scenario, options.seed, make, states)
        received = np.array([link.received(codebook, cycle_id, cycle_id, position)
                             for cycle_id, position in enumerate(positions, 1)])
        fixes = frame.Fixes.of(estimator.estimate(received), positions)
        figures[name] = table.row(name, **fixes.figures())
    frame.write_results(options.json, figures)


if __name__ == '__main__':
    frame.run(main)
