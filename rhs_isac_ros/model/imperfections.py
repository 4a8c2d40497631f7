"""Random draws of the deviations that a scenario declares: surfaces, users and cycles."""

import dataclasses
import hashlib
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.multipath import complex_normal
from rhs_isac_ros.model.nuisance import draw_nuisance, nuisance_factors, nuisance_parameters
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming


class AppliedBeams(NamedTuple):
    """Beamforming whose coefficients need not be real, or levels of the surface."""

    analog: np.ndarray
    digital: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceImperfection:
    """Errors of the elements of one surface, the same in all bands and frames.

    Attributes
    ----------
    gains
        Factor of the coefficient of each element, complex128 [N_E]; 1 without an error.
    stuck
        Amplitude of each failed element, float64 [N_E]; NaN where an element works.
    """

    gains: np.ndarray
    stuck: np.ndarray

    @property
    def id(self) -> str:
        """Hash of the errors, 16 hexadecimal digits."""
        digest = hashlib.sha256(np.asarray(self.gains, complex).astype('<c16').tobytes())
        digest.update(np.asarray(self.stuck, float).astype('<f8').tobytes())
        return digest.hexdigest()[:16]

    def applied(self, analog: np.ndarray) -> np.ndarray:
        """Return the coefficients in effect, complex128, for configurations [..., N_E].

        Raise ValueError if the surface has another number of elements.
        """
        if analog.shape[-1:] != self.gains.shape:
            raise ValueError(f'surface: {len(self.gains)} elements, expected N_E = '
                             f'{analog.shape[-1]} as in the configurations')
        coefficients: np.ndarray = np.where(np.isnan(self.stuck), analog, self.stuck) * self.gains
        return coefficients

    def applied_beams(self, beams: Beamforming) -> AppliedBeams:
        """Return the beamforming in effect."""
        return AppliedBeams(self.applied(beams.analog), beams.digital)


def has_element_errors(scenario: Scenario) -> bool:
    """Return whether a scenario declares errors or failures of elements."""
    return scenario.element_error_rms > 0 or scenario.failed_element_share > 0


def draw_surface(scenario: Scenario, rng: np.random.Generator) -> SurfaceImperfection:
    """Draw the errors of a surface.

    Generators in the same state give the same errors up to their declared size, and a higher
    share of failed elements adds failures.
    """
    n_elements = scenario.n_elements
    fate, levels = rng.uniform(size=(2, n_elements))
    gains = 1 + scenario.element_error_rms * complex_normal((n_elements,), rng)
    return SurfaceImperfection(
        gains, np.where(fate < scenario.failed_element_share, levels, np.nan))


def draw_deviations(
        scenario: Scenario, n: int, rng: np.random.Generator
) -> tuple[SurfaceImperfection | None, np.ndarray | None]:
    """Draw a surface and the factors of the signals of n phases, complex128 [n, N_B, N_SB F].

    Each phase has another user. Either result is None if the scenario does not declare it. The
    numbers come from children of the generator, so that those which it yields itself, of
    multipath and noise, do not depend on what is declared.
    """
    surface, factors = None, None
    if has_element_errors(scenario) or nuisance_parameters(scenario):
        of_surface, of_users = rng.spawn(2)
        if has_element_errors(scenario):
            surface = draw_surface(scenario, of_surface)
        if nuisance_parameters(scenario):
            factors = nuisance_factors(scenario, draw_nuisance(scenario, n, of_users))
    return surface, factors
