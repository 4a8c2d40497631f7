"""The modes of the posterior and the global bound, which no message contains."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rhs_isac_ros.bounds import global_bound
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.positioning import (
    BayesEstimator,
    Estimate,
    SignalError,
    WeightedModes,
    weighted_modes,
)
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.newest import NewestDict
from rhs_isac_ros.protocol.tracks import Tracks

# Number of codebooks, each with tables of some megabytes; more are unusual even in a recording.
_MAX_CODEBOOKS = 32
# With Table I, the bound on the root mean squared error then has a standard error of 2.4 %.
_N_PHASES = 256


class Posteriors:
    """The posteriors of received signals, for the latest codebooks that were added.

    The messages of the network do not contain the modes: sending them would lengthen every cycle.

    Parameters
    ----------
    surface
        What is known of the surface, as in `make_estimator`.
    """

    def __init__(
            self, scenario: Scenario, surface: Surface | None = None,
            table_folder: Path | None = None) -> None:
        self._scenario, self._surface = scenario, surface
        self._table_folder = table_folder or default_folder()
        self._estimators: NewestDict[str, BayesEstimator] = NewestDict(_MAX_CODEBOOKS)
        self._tracks = Tracks()

    @property
    def codebooks(self) -> Mapping[str, object]:
        """The codebooks that were added, by id, up to 32."""
        return self._estimators

    def add(self, codebook: Codebook) -> None:
        """Prepare for signals received with a codebook.

        Raises
        ------
        CodebookError
            If the codebook does not fit the scenario.
        """
        codebook.check(self._scenario)
        self._estimators.put(codebook.id, BayesEstimator(
            self._scenario, codebook, self._table_folder, surface=self._surface))

    def bound_m2(self, codebook: Codebook) -> float:
        """Compute the global bound on the mean squared error with a codebook [m^2].

        This takes some seconds.
        """
        return global_bound(
            self._scenario, codebook, np.random.default_rng(0), _N_PHASES).value

    def modes(self, received: m.ReceivedSignals) -> WeightedModes | None:
        """Return the modes of the posterior; None without a position or a known codebook."""
        estimator = self._estimators.get(received.codebook_id)
        if estimator is None:
            return None
        try:
            return weighted_modes(estimator, received.signals)
        except SignalError:
            return None

    def track(
            self, received: m.ReceivedSignals, now_s: float, speed_mps: float) -> Estimate | None:
        """Continue the track of a user.

        Parameters
        ----------
        now_s
            Time at which the signals arrived [s].
        speed_mps
            Typical speed of the users [m/s].

        Returns
        -------
        Estimate or None
            A `TrackEstimate` from the second position on; None without a known codebook.
        """
        estimator = self._estimators.get(received.codebook_id)
        if estimator is None:
            return None
        try:
            return self._tracks.locate(received, estimator, speed_mps, now_s)
        except SignalError:
            return None
