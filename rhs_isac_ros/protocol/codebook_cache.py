"""What roles keep for a codebook: of the newest few, and of the one in use."""

from typing import Generic, TypeVar

Item = TypeVar('Item')
# Codebooks that may be offered while a cycle runs, before the oldest is forgotten.
_NEWEST = 3


class CodebookCache(Generic[Item]):
    """Things by codebook id. The base station alone knows which codebook a cycle uses.

    Attributes
    ----------
    in_use
        Id of what was taken last; empty before.
    """

    def __init__(self) -> None:
        self._items: dict[str, Item] = {}
        self.in_use = ''

    def put(self, codebook_id: str, item: Item) -> None:
        """Keep something; beyond the newest few and the one in use, the oldest goes.

        Parameters
        ----------
        codebook_id
            The id.
        item
            The thing.
        """
        self._items.pop(codebook_id, None)
        self._items[codebook_id] = item
        others = [known for known in self._items if known != self.in_use]
        for known in others[:-_NEWEST]:
            del self._items[known]

    def take(self, codebook_id: str) -> Item:
        """Return what was put for a codebook, which is in use from now on.

        Parameters
        ----------
        codebook_id
            The id.

        Returns
        -------
        Item
            The thing.

        Raises
        ------
        KeyError
            If nothing is there for it.
        """
        item = self._items[codebook_id]
        self.in_use = codebook_id
        return item

    def peek(self, codebook_id: str) -> Item | None:
        """Return what was put for a codebook, and leave the one in use.

        Parameters
        ----------
        codebook_id
            The id.

        Returns
        -------
        Item or None
            The thing, if it is there.
        """
        return self._items.get(codebook_id)

    def __contains__(self, codebook_id: str) -> bool:
        """Tell whether something is there for a codebook."""
        return codebook_id in self._items

    def ids(self) -> list[str]:
        """Return the ids of what is there.

        Returns
        -------
        list of str
            The oldest first.
        """
        return list(self._items)
