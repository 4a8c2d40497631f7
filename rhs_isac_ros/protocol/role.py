"""What the roles without a state machine have in common."""

import collections
from collections.abc import Mapping


class PlainRole:
    """A role that only answers messages.

    Attributes
    ----------
    counters
        What was dropped, by reason.
    """

    def __init__(self) -> None:
        self.counters: collections.Counter[str] = collections.Counter()

    def status(self) -> Mapping[str, str]:
        """Return what is in use and what waits, for the diagnostics.

        Returns
        -------
        Mapping
            Values by name, such as ``parameter.estimator`` and ``pending.estimator``, and the
            ``codebook_id`` in use; empty if all of that is fixed.
        """
        return {}

    def next_deadline(self) -> float | None:
        """Return when the role wants a `Tick`: never.

        Returns
        -------
        None
            It waits for messages only.
        """
        return None
