"""What the roles without a state machine have in common."""

import collections


class PlainRole:
    """A role that only answers messages.

    Attributes
    ----------
    counters
        What was dropped, by reason.
    """

    def __init__(self) -> None:
        self.counters: collections.Counter[str] = collections.Counter()

    def next_deadline(self) -> float | None:
        """Return when the role wants a `Tick`: never.

        Returns
        -------
        None
            It waits for messages only.
        """
        return None
