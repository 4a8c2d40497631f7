"""Codebooks of analog and digital beamforming, and their optimisation."""

from rhs_isac_ros.codebook.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.optimize import METHODS, OptimizeResult, Progress, optimize
from rhs_isac_ros.codebook.start import random_codebook

__all__ = [
    'METHODS', 'Codebook', 'CodebookError', 'OptimizeResult', 'Progress', 'optimize',
    'random_codebook',
]
