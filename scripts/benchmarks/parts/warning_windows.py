"""The monitor of the residuals, applied to windows of phases."""

from typing import Any

import numpy as np

from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.positioning.diagnosis import WINDOW, InnovationTest


def warnings(estimate: Estimate, n_windows: int) -> dict[str, Any]:
    """Apply the monitor of the positioner to the phases in order, and to random windows of them.

    Returns
    -------
    dict
        ``warns_after``, the number of phases until the first warning, None without one; and
        ``warned_share``, the share of windows with a warning [%].
    """
    residuals = np.stack([estimate.residual, estimate.expected_residual], axis=1)
    order = np.random.default_rng(0).integers(len(residuals), size=(n_windows, WINDOW))
    n_warned = sum(first_warning(residuals[window]) is not None for window in order)
    return {'warns_after': first_warning(residuals),
            'warned_share': share_percent(n_warned, n_windows)}


def first_warning(residuals: np.ndarray) -> int | None:
    """Return the number of phases until the monitor warns; None if it does not."""
    monitor = InnovationTest()
    for count, (energy, expected) in enumerate(residuals.tolist(), 1):
        monitor.add(energy, expected)
        if monitor.drifts:
            return count
    return None
