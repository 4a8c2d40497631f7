"""Values of a function for the arguments of its most recent calls."""

import collections
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, Generic, TypeVar

_Key = TypeVar('_Key', bound=Hashable)
_Value = TypeVar('_Value')


class Recent(Generic[_Key, _Value]):
    """A function of one argument that keeps its values of the most recent arguments.

    Unlike a function decorated with `functools.lru_cache`, it can be an attribute of an object
    that is copied or pickled. Copies start without values. Threads may share it; two of them that
    need the same value at the same time both compute it.

    Parameters
    ----------
    compute
        The function; of a module or a method, if the object is to be pickled.
    n_kept
        Number of values to keep, from 1.

    Examples
    --------
    >>> magnitude = Recent(abs, 2)
    >>> magnitude(-3)
    3
    """

    def __init__(self, compute: Callable[[_Key], _Value], n_kept: int) -> None:
        self._compute, self._n_kept = compute, n_kept
        self._values = collections.OrderedDict[_Key, _Value]()

    def __call__(self, key: _Key) -> _Value:
        """Return the value for a key."""
        try:
            value = self._values.pop(key)
        except KeyError:
            value = self._compute(key)
        # The most recent key is the last one.
        self._values[key] = value
        if len(self._values) > self._n_kept:
            self._values.popitem(last=False)
        return value

    def keep(self, keys: Iterable[_Key],
             compute: Callable[[Sequence[_Key]], Iterable[_Value]]) -> None:
        """Compute the values of those keys that have none with one call."""
        if new := [key for key in keys if key not in self._values]:
            self._values.update(zip(new, compute(new), strict=True))

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has."""
        return {**vars(self), '_values': collections.OrderedDict()}
