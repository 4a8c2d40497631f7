"""The system model of the paper: geometry, propagation, surface and received signals."""

from rhs_isac_ros.model.fields import ScenarioError
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.imperfections import SurfaceImperfection, draw_surface
from rhs_isac_ros.model.measurement import MeasurementModel
from rhs_isac_ros.model.nuisance import NuisanceParameter, nuisance_parameters
from rhs_isac_ros.model.receive import simulate_received
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.surface import Beamforming

__all__ = [
    'SPEED_OF_LIGHT_MPS', 'Beamforming', 'GainPattern', 'MeasurementModel', 'NuisanceParameter',
    'Scenario', 'ScenarioError', 'SurfaceImperfection', 'draw_surface', 'nuisance_parameters',
    'simulate_received',
]
