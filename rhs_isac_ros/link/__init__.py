"""The transmission phase: capacity, beam steering and the choice of the band."""

from rhs_isac_ros.link.beam_pattern import BeamPattern, beam_pattern
from rhs_isac_ros.link.capacity import Beam, capacity, expected_capacity
from rhs_isac_ros.link.quartiles import RunningQuartiles
from rhs_isac_ros.link.steering import Choice, Outcome, choose_beam, outcome, steer

__all__ = [
    'Beam', 'BeamPattern', 'Choice', 'Outcome', 'RunningQuartiles', 'beam_pattern', 'capacity',
    'choose_beam', 'expected_capacity', 'outcome', 'steer']
