"""Impairments: effects beyond the paper's model that a scenario declares as unknown.

Given the position, the signals of a cycle are Gaussian if a few Gaussian numbers and the elements
of the surface are known. An impairment is one of two things:

* Unknown numbers x with a Gaussian prior and an exponent ``exp(x P)`` of the signals: gains,
  phases, offsets of timing and carrier. See `Impairment`.
* Unknown coefficients of the elements, which add to the covariance, and of which some sets have
  failed. See `DeclaredElements`.

Simulation, estimators, bounds and calibration use only what these objects return, so that another
impairment requires no change elsewhere: a `Factor` in `factors`, or a plug-in of the group
``rhs_isac_ros.impairments``.
"""

from rhs_isac_ros.model.impairments.elements import (
    AppliedBeams,
    DeclaredElements,
    ElementErrors,
    SurfaceModel,
    draw_surface,
)
from rhs_isac_ros.model.impairments.factors import (
    BUILT_IN,
    Factor,
    draw_factors,
    draw_impairments,
    impairments_of,
    nuisance_of,
)
from rhs_isac_ros.model.impairments.impairment import Impairment, Linear, Nuisance, Scope

__all__ = [
    'BUILT_IN', 'AppliedBeams', 'DeclaredElements', 'ElementErrors', 'Factor', 'Impairment',
    'Linear', 'Nuisance', 'Scope', 'SurfaceModel', 'draw_factors', 'draw_impairments',
    'draw_surface', 'impairments_of', 'nuisance_of',
]
