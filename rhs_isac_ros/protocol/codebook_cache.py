"""A cache of objects derived from codebooks, for the latest few and the one in use."""

from typing import Generic, TypeVar

from rhs_isac_ros.protocol.newest import NewestDict

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
