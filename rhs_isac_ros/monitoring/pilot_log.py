"""Pilots at known positions, assembled from the messages of a network."""

import numpy as np

from rhs_isac_ros.calibration import Pilots
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m

# Messages that the log needs.
RECEIVES = (m.GroundTruth, m.ReceivedSignals)


class PilotLog:
    """Collects received signals, the true positions of their users, and codebooks.

    Unlike in a `CycleLog`, cycles without a fix count: before a calibration, there may be no
    others.

    Parameters
    ----------
    user
        The only user whose signals are collected; 0 for all users.
    """

    def __init__(self, scenario: Scenario, user: int = 0) -> None:
        self._scenario, self._user = scenario, user
        self._truths: dict[tuple[int, int], list[m.GroundTruth]] = {}
        self._signals: dict[int, m.ReceivedSignals] = {}
        self._codebooks: dict[str, Codebook] = {}

    def add(self, message: m.Message) -> None:
        """Add a message of one of the types `RECEIVES`."""
        match message:
            case m.GroundTruth() if message.cycle_id:
                self._truths.setdefault((message.cycle_id, message.user), []).append(message)
            case m.ReceivedSignals() if self._user in (0, message.user):
                self._signals.setdefault(message.cycle_id, message)

    def add_codebook(self, codebook: Codebook, codebook_id: str = '') -> None:
        """Add a codebook; another one may be assumed for signals with an id.

        Raises
        ------
        CodebookError
            If the codebook does not fit the scenario.
        """
        codebook.check(self._scenario)
        self._codebooks[codebook_id or codebook.id] = codebook

    @property
    def n_signals(self) -> int:
        """Number of phases whose signals were received."""
        return len(self._signals)

    @property
    def n_pilots(self) -> int:
        """Number of pilots whose position and codebook are known."""
        return sum(len(group.positions) for group in self.pilots())

    @property
    def missing_codebooks(self) -> list[str]:
        """Ids of codebooks that are not known, although signals were received with them."""
        return sorted({signals.codebook_id for signals in self._signals.values()}
                      - self._codebooks.keys())

    def pilots(self) -> list[Pilots]:
        """Return the pilots of each codebook."""
        groups: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for signals in self._signals.values():
            truth = self._truth_of(signals)
            if truth is not None and signals.codebook_id in self._codebooks:
                groups.setdefault(signals.codebook_id, []).append(
                    (truth.position, signals.signals.reshape(len(signals.signals), -1)))
        return [Pilots(self._codebooks[codebook_id], *map(np.array, zip(*group, strict=True)))
                for codebook_id, group in groups.items()]

    def _truth_of(self, signals: m.ReceivedSignals) -> m.GroundTruth | None:
        known = self._truths.get((signals.cycle_id, signals.user), [])
        return next((truth for truth in reversed(known)
                     if m.same_instance(truth.sender, signals.user_instance)), None)
