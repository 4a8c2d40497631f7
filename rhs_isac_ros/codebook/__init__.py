"""Codebooks of analog and digital beamforming, and their optimisation."""

from rhs_isac_ros.codebook.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.directional import directional_codebook
from rhs_isac_ros.codebook.objective import OBJECTIVES
from rhs_isac_ros.codebook.optimize import METHODS, OptimizeResult, optimize
from rhs_isac_ros.codebook.provenance import Provenance
from rhs_isac_ros.codebook.sampling import SAMPLINGS
from rhs_isac_ros.codebook.search import Progress
from rhs_isac_ros.codebook.shipped import default_codebook_file
from rhs_isac_ros.codebook.start import random_codebook

__all__ = [
    'METHODS', 'OBJECTIVES', 'SAMPLINGS', 'Codebook', 'CodebookError', 'OptimizeResult',
    'Progress', 'Provenance', 'default_codebook_file', 'directional_codebook', 'optimize',
    'random_codebook',
]
