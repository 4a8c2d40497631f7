"""The system model of the paper: geometry, propagation, surface and received signals."""

from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.impairments import ElementErrors, Impairment, Linear, Scope, draw_surface
from rhs_isac_ros.model.measurement import MeasurementModel
from rhs_isac_ros.model.multipath_estimate import MultipathEstimate
from rhs_isac_ros.model.path_channel import PathChannel
from rhs_isac_ros.model.receive import simulate_received
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario, ScenarioError
from rhs_isac_ros.model.surface import Beamforming

__all__ = [
    'SPEED_OF_LIGHT_MPS', 'Beamforming', 'ElementErrors', 'GainPattern', 'Impairment', 'Linear',
    'MeasurementModel', 'MultipathEstimate', 'PathChannel', 'Scenario', 'ScenarioError', 'Scope',
    'draw_surface', 'simulate_received',
]
