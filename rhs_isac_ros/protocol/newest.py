"""Dictionaries of bounded size."""

import itertools
from typing import Generic, TypeVar

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


Item = TypeVar('Item')
# Maximum number of codebooks offered during a cycle before the oldest one is discarded.
_MAX_OFFERED = 3


class CodebookCache(Generic[Item]):
    """Items by codebook id; the item in use is never discarded.

    Attributes
    ----------
    in_use
        Id of the item that was taken last; empty at first.
    """

    def __init__(self) -> None:
        self._items: NewestDict[str, Item] = NewestDict(_MAX_OFFERED)
        self.in_use = ''

    def put(self, codebook_id: str, item: Item) -> None:
        """Store an item as the latest; the oldest one not in use may be discarded."""
        self._items.put(codebook_id, item, pinned=self.in_use)

    def take(self, codebook_id: str) -> Item:
        """Return the item of a codebook and mark it as in use.

        Raises
        ------
        KeyError
            If the codebook has no item.
        """
        item = self._items[codebook_id]
        self.in_use = codebook_id
        return item

    def peek(self, codebook_id: str) -> Item | None:
        """Return the item of a codebook, or None; the item in use stays the same."""
        return self._items.get(codebook_id)

    def __contains__(self, codebook_id: str) -> bool:
        """Return whether a codebook has an item."""
        return codebook_id in self._items

    def ids(self) -> list[str]:
        """Return the ids of all items, the oldest first."""
        return list(self._items)
