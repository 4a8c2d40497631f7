"""Dictionaries of bounded size."""

import itertools
from typing import TypeVar

Key = TypeVar('Key')
Value = TypeVar('Value')


class NewestDict(dict[Key, Value]):
    """A dictionary that keeps only its newest entries; `put` adds them.

    Parameters
    ----------
    max_size
        Number of entries that it keeps.
    """

    def __init__(self, max_size: int) -> None:
        super().__init__()
        self.max_size = max_size

    def put(self, key: Key, value: Value, pinned: Key | None = None) -> int:
        """Store an entry as the newest and discard the oldest beyond the limit.

        Parameters
        ----------
        pinned
            Key of an entry that is neither discarded nor counted towards the limit.

        Returns
        -------
        int
            Number of entries that were discarded.
        """
        self.pop(key, None)
        self[key] = value
        # Stops at the last entry to discard, because most calls discard none.
        n_surplus = len(self) - (pinned in self) - self.max_size
        surplus = list(itertools.islice(
            (known for known in self if known != pinned), max(n_surplus, 0)))
        for known in surplus:
            del self[known]
        return len(surplus)
