"""Calibration of a surface, and survey of a hall, from signals of users at known positions."""

from rhs_isac_ros.calibration.calibration import (
    Calibration,
    CalibrationError,
    calibrate,
    load_surface,
    report,
)
from rhs_isac_ros.calibration.estimate import Pilots, prior_of
from rhs_isac_ros.calibration.mixture import SurfacePrior
from rhs_isac_ros.calibration.survey import SurveyWarning, survey, survey_report

__all__ = [
    'Calibration', 'CalibrationError', 'Pilots', 'SurfacePrior', 'SurveyWarning', 'calibrate',
    'load_surface', 'prior_of', 'report', 'survey', 'survey_report',
]
