"""Whose acks a base station takes, and how many of them."""

import collections
import math
import re

_RANGE = re.compile(r'\s*(\d+)\s*(?:-\s*(\d+)\s*)?')
_LAST_USER = 2**32 - 1


class AckFilter:
    """Refuses acks of users that are not allowed, and of those that send too many.

    Parameters
    ----------
    allowed
        Numbers of the users, as `parse_users` returns them; empty: all.
    rate_hz
        Acks that it takes of each user in a second.
    """

    def __init__(self, allowed: tuple[range, ...] = (), rate_hz: float = math.inf) -> None:
        self._allowed, self._rate_hz = allowed, rate_hz
        # Acks by user in the present second; the next one forgets them, whoever they are of.
        self._acks: collections.Counter[int] = collections.Counter()
        self._second: int | None = None

    def refusal(self, user: int, now_s: float) -> str:
        """Count an ack, and tell why it is refused.

        Parameters
        ----------
        user
            Whose ack it is.
        now_s
            The time, on any clock that only goes forward [s].

        Returns
        -------
        str
            ``not_allowed`` or ``too_often``; empty if it is taken.
        """
        if self._allowed and not any(user in numbers for numbers in self._allowed):
            return 'not_allowed'
        second = math.floor(now_s)
        if second != self._second:
            self._second = second
            self._acks.clear()
        self._acks[user] += 1
        return 'too_often' if self._acks[user] > self._rate_hz else ''


def parse_users(text: str) -> tuple[range, ...]:
    """Read a list of users, such as ``1, 4, 10-20``.

    Parameters
    ----------
    text
        Numbers from 1 and ranges of them, with commas; or nothing.

    Returns
    -------
    tuple of range
        The numbers; none for an empty text.

    Raises
    ------
    ValueError
        If a part is neither a number nor a range that goes up.
    """
    return tuple(_range_of(part) for part in text.split(',')) if text.strip() else ()


def _range_of(part: str) -> range:
    match = _RANGE.fullmatch(part)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
    if not 1 <= first <= last <= _LAST_USER:
        raise ValueError(f'{part.strip()!r}, expected numbers from 1 to {_LAST_USER} and ranges '
                         'such as 10-20')
    return range(first, last + 1)
