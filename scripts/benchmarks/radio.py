"""Positioning error with each radio of the front end, and with two free clocks.

Problem: how much accuracy do pilots as samples cost, whose start, carrier and noise are unknown,
in place of sub-bands that are measured directly with equal noise? If the clocks of user and front
end differ, the carrier turns the phase from frame to frame, and the delay grows. How much of this
does the modem correct, which estimates the drift from the repeated symbols? Each position is one
cycle of the role `channel` in config/lab.yaml, with the states of the elements in lab_states.npz.
Brackets contain 95 % intervals.
"""

import functools
from collections.abc import Callable

import numpy as np
from parts import frame

from rhs_isac_ros.calibration.calibration import load_surface
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.frontend import (
    Air,
    EmulatedRadio,
    EmulatedSurface,
    FrontEnd,
    Radio,
    Waveform,
    WaveformRadio,
)
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel, apply_patterns
from rhs_isac_ros.protocol.settings import Impairments
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
        received = measured(scenario, codebook, states, make, positions, options.seed)
        fixes = frame.Fixes.of(estimator.estimate(received), positions)
        figures[name] = table.row(name, **fixes.figures())
    frame.write_results(options.json, figures)


def measured(scenario: Scenario, codebook: Codebook, states: SurfaceEstimate,
             make: Callable[[Scenario, Air], Radio], positions: np.ndarray, seed: int
             ) -> np.ndarray:
    """Return the received signals of one cycle at each position, complex128 [N, N_B, N_SB F]."""
    rng = np.random.default_rng(seed)
    air = Air(scenario, rng)
    radio = make(scenario, air)
    front_end = FrontEnd(EmulatedSurface(scenario.n_elements), radio, air)
    channel = Channel(scenario, seed, Impairments(multipath_memory=False), states)
    # Other radios have noise of their own.
    noise = rng if isinstance(radio, EmulatedRadio) else None
    received = []
    for cycle_id, position in enumerate(positions, 1):
        # Its start and carrier are drawn again.
        radio.close()
        feeds = [_feeds(channel, front_end, codebook, cycle_id, position, band)
                 for band in range(scenario.n_bands)]
        received.append(receive_feeds(scenario, codebook, np.stack(feeds), noise))
    return np.reshape(received, (len(positions), scenario.n_bands, -1))


def _feeds(channel: Channel, front_end: FrontEnd, codebook: Codebook, cycle_id: int,
           position: np.ndarray, band: int) -> np.ndarray:
    """Return the signals at the feeds for the pilots of a band, complex128 [F, N_SB, K]."""
    analog, user = codebook.analog[band], cycle_id
    for event in (
            m.GroundTruth(cycle_id=cycle_id, user=user, position=position, velocity=np.zeros(3)),
            m.RhsConfiguration(cycle_id=cycle_id, mode=m.Mode.POSITIONING, band=band,
                               codebook_id=codebook.id, analog=analog),
            m.Pilot(cycle_id=cycle_id, user=user, band=band,
                    symbols=np.ones(len(analog), complex))):
        actions = channel.handle(event, 0.0)
    (answer,) = channel.handle(apply_patterns(front_end, actions[0]), 0.0)
    return answer.message.signals


if __name__ == '__main__':
    frame.run(main)
