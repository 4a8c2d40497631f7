"""The transmission phase: capacity and beam steering."""

from rhs_isac_ros.link.capacity import Beam, capacity
from rhs_isac_ros.link.steer import steer

__all__ = ['Beam', 'capacity', 'steer']
