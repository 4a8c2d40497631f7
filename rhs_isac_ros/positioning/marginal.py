"""Evidence and modes of signals whose gain, phases or timing the scenario declares as unknown."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.band_phases import BandPhases
from rhs_isac_ros.positioning.broad_modes import draw_broad_samples
from rhs_isac_ros.positioning.element_error_model import ElementErrorModel
from rhs_isac_ros.positioning.joint_modes import find_joint_modes
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.samples import Samples
from rhs_isac_ros.positioning.surroundings import Surroundings
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.positioning.unknowns import Alignment, Unknowns
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Samples of a mode if the phases of the bands carry information: their density has several peaks
# within a mode, so that fewer samples have most of the weight.
_N_INFORMATIVE = 512
# Quadrature over the gain outside of the region: spacing [nepers], and reach in standard
# deviations.
_GAIN_STEP = 0.04
_GAIN_REACH = 4.0


class Found(NamedTuple):
    """What a search found for one positioning phase.

    Attributes
    ----------
    modes
        Modes of the posterior.
    residuals
        Energy of the whitened residual at each mode, float64 [M].
    whitened
        Whitened signals without the offsets of carrier and timing, complex128 [N_B, N_SB F].
    log_evidence_outside
        Evidence for a user outside of the region.
    scale_outside
        Factor of the signals, from the gain, that is most probable outside.
    samples
        Samples of the posterior if the modes are too broad for a Gaussian.
    """

    modes: Modes
    residuals: np.ndarray
    whitened: np.ndarray
    log_evidence_outside: float
    scale_outside: float = 1.0
    samples: Samples | None = None


class MarginalSearch:
    """The search for modes with the nuisance parameters of a scenario eliminated.

    Without `surroundings`, the evidence outside of the region is zero.
    """

    def __init__(self, model: WhitenedModel, table: TemplateTable,
                 surroundings: Surroundings | None, error: ElementErrorModel | None) -> None:
        self._error = error
        self._model, self._table, self._surroundings = model, table, surroundings
        self.unknowns = Unknowns(model)
        self._alignment = Alignment(model, self.unknowns, table.filters)
        self._is_broad = error is None and self.unknowns.is_coarse
        self._phases = BandPhases(model, self.unknowns)
        self._normal = table.normal
        if self._is_broad and self._phases.is_informative:
            self._normal = standard_normal(_N_INFORMATIVE)

    def find(self, received: np.ndarray) -> Found:
        """Find the modes for the signals of one positioning phase, [N_B, N_SB F]."""
        aligned = self._alignment.values(received)
        joint = find_joint_modes(self._model, self._table, self.unknowns, received, aligned)
        whitened = self._model.whiten((received * self.unknowns.factors(aligned))[None])[0]
        modes, residuals = joint.modes, joint.residual
        if self._error:
            divided = received * self.unknowns.factors(joint.values)
            modes, residuals = self._error.refine(modes, divided, step=False)
        samples = (draw_broad_samples(
            self._model, self.unknowns, self._phases, received, joint, self._normal)
            if self._is_broad else None)
        outside = (-np.inf, 1.0)
        if self._surroundings:
            outside = self._outside(self._surroundings, whitened, aligned)
        return Found(modes, residuals, whitened, *outside, samples)

    def _outside(self, surroundings: Surroundings, whitened: np.ndarray,
                 aligned: np.ndarray) -> tuple[float, float]:
        """Compute the evidence outside, with the sharp parameters by Laplace's method.

        Returns
        -------
        evidence, scale
            Logarithm of the evidence, and the most probable factor of the signals.
        """
        unknowns, sharp = self.unknowns, self.unknowns.sharp
        evidence, scale = self._over_gain(surroundings, whitened)
        if sharp:
            precision = unknowns.precision[sharp]
            curvature = unknowns.information[np.ix_(sharp, sharp)] + np.diag(precision)
            evidence -= float(
                aligned[sharp]**2 @ precision / 2 + np.linalg.slogdet(curvature)[1] / 2
                + np.sum(np.log(unknowns.std[sharp])))
        return evidence, scale

    def _over_gain(
            self, surroundings: Surroundings, whitened: np.ndarray) -> tuple[float, float]:
        """Average the evidence outside over the gain; also return the most probable scale."""
        unknowns = self.unknowns
        if unknowns.gain is None:
            return float(surroundings.log_evidence(whitened)[0]), 1.0
        std = unknowns.std[unknowns.gain]
        n_points = 2 * int(np.ceil(_GAIN_REACH * std / _GAIN_STEP)) + 3
        gain = std * np.linspace(-_GAIN_REACH, _GAIN_REACH, n_points)
        prior = -gain**2 / (2 * std**2)
        prior -= np.log(np.sum(np.exp(prior)))
        evidence = surroundings.log_evidence(whitened, np.exp(-gain))
        evidence += prior - 2 * whitened.size * gain
        best = int(np.argmax(evidence))
        total = evidence[best] + np.log(np.sum(np.exp(evidence - evidence[best])))
        return float(total), float(np.exp(-gain[best]))
