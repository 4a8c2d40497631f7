"""Calibration of a surface, and survey of a hall, from signals of users at known positions."""

from rhs_isac_ros.calibration.calibration import (
    Calibration,
    CalibrationError,
    CalibrationWarning,
    calibrate,
    known_states,
    load_surface,
    report,
)
from rhs_isac_ros.calibration.estimate import Pilots, prior_of
from rhs_isac_ros.calibration.mixture import SurfacePrior
from rhs_isac_ros.calibration.survey import SurveyWarning, survey, survey_report

__all__ = [
    'Calibration', 'CalibrationError', 'CalibrationWarning', 'Pilots', 'SurfacePrior',
    'SurveyWarning', 'calibrate', 'known_states', 'load_surface', 'prior_of', 'report', 'survey',
    'survey_report',
]
