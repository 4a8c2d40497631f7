"""The transmission phase: capacity, beam steering and the choice of the band."""

from rhs_isac_ros.link.capacity import (
    Beamformer,
    BeamPattern,
    actual_capacity,
    beam_pattern,
    capacity,
    expected_capacities,
)
from rhs_isac_ros.link.steering import (
    CapacityReport,
    Choice,
    applied_beam,
    capacity_report,
    choose_beam,
    prepare_steering,
    steer,
)

# The former name, with which programs call `capacity`; a message has it, too.
Beam = Beamformer

__all__ = [
    'BeamPattern', 'Beamformer', 'CapacityReport', 'Choice', 'actual_capacity', 'applied_beam',
    'beam_pattern', 'capacity', 'capacity_report', 'choose_beam', 'expected_capacities',
    'prepare_steering', 'steer']
