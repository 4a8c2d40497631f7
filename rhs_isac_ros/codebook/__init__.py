"""Codebooks of analog and digital beamforming, and their optimisation."""

from rhs_isac_ros.codebook.codebook import (
    Codebook,
    CodebookError,
    Provenance,
    default_codebook_file,
)
from rhs_isac_ros.codebook.objective import OBJECTIVES, SAMPLINGS
from rhs_isac_ros.codebook.optimize import METHODS, OptimizeResult, optimize
from rhs_isac_ros.codebook.problem import Progress
from rhs_isac_ros.codebook.unoptimised import directional_codebook, random_codebook

__all__ = [
    'METHODS', 'OBJECTIVES', 'SAMPLINGS', 'Codebook', 'CodebookError', 'OptimizeResult',
    'Progress', 'Provenance', 'default_codebook_file', 'directional_codebook', 'optimize',
    'random_codebook',
]
