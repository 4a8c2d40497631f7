"""The system model of the paper, with extensions: geometry, propagation, surface and signals."""

from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.elements import ElementErrors, SurfaceEstimate, draw_surface
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.hall import MultipathEstimate, PathChannel
from rhs_isac_ros.model.impairments import Impairment, Linear, Scope
from rhs_isac_ros.model.measurement import MeasurementModel, simulate_received
from rhs_isac_ros.model.numerology import nr_grid
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.model.scenario import Scenario, ScenarioError
from rhs_isac_ros.model.surface import Beamforming

__all__ = [
    'SPEED_OF_LIGHT_MPS', 'Beamforming', 'ElementErrors', 'GainPattern', 'Impairment', 'Linear',
    'MeasurementModel', 'MultipathEstimate', 'PathChannel', 'Pose', 'Scenario', 'ScenarioError',
    'Scope', 'SurfaceEstimate', 'draw_surface', 'nr_grid',
    'simulate_received',
]
