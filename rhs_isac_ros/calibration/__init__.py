"""Calibration of a surface, and survey of a hall, from signals of users at known positions."""

from rhs_isac_ros.calibration.boards import BoardFit, board_evidence, fit_board
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
    'BoardFit', 'Calibration', 'CalibrationError', 'CalibrationWarning', 'Pilots', 'SurfacePrior',
    'SurveyWarning', 'board_evidence', 'calibrate', 'fit_board', 'known_states', 'load_surface',
    'prior_of', 'report', 'survey', 'survey_report',
]
