"""The system model of the paper: geometry, propagation, surface and received signals."""

from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.receive import mean_received, simulate_received
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario, ScenarioError
from rhs_isac_ros.model.surface import Beamforming

__all__ = [
    'SPEED_OF_LIGHT_MPS', 'Beamforming', 'GainPattern', 'Scenario', 'ScenarioError',
    'mean_received', 'simulate_received',
]
