"""Calibration of a surface from signals of a user at known positions."""

from rhs_isac_ros.calibration.calibration import (
    Calibration,
    CalibrationError,
    calibrate,
    load_surface,
    report,
)
from rhs_isac_ros.calibration.estimate import Pilots, estimate_surface, prior_of
from rhs_isac_ros.calibration.mixture import SurfacePrior

__all__ = [
    'Calibration', 'CalibrationError', 'Pilots', 'SurfacePrior', 'calibrate', 'estimate_surface',
    'load_surface', 'prior_of', 'report',
]
