"""The transmission phase: capacity, beam steering and the choice of the band."""

from rhs_isac_ros.link.beam_pattern import BeamPattern, beam_pattern
from rhs_isac_ros.link.capacity import Beam, capacity
from rhs_isac_ros.link.choice import Choice, choose_beam
from rhs_isac_ros.link.expected import expected_capacity
from rhs_isac_ros.link.outcome import Outcome, outcome
from rhs_isac_ros.link.quartiles import RunningQuartiles
from rhs_isac_ros.link.steer import steer

__all__ = [
    'Beam', 'Choice', 'Outcome', 'BeamPattern', 'RunningQuartiles', 'capacity', 'choose_beam',
    'expected_capacity', 'outcome', 'beam_pattern', 'steer']
