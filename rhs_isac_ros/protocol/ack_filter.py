"""Restrictions on the acks that a base station accepts."""

import collections
import math
import re

_RANGE = re.compile(r'\s*(\d+)\s*(?:-\s*(\d+)\s*)?')
_LAST_USER = 2**32 - 1


class AckFilter:
    """Restricts the users whose acks are accepted, and the acks of each user per second.

    Parameters
    ----------
    allowed
        Ids of the users, as returned by `parse_users`; empty: all.
    rate_hz
        Maximum number of acks of each user in a second.
    """

    def __init__(self, allowed: tuple[range, ...] = (), rate_hz: float = math.inf) -> None:
        self._allowed, self._rate_hz = allowed, rate_hz
        # Acks by user in the current second; they are discarded every second, which bounds the
        # memory.
        self._acks: collections.Counter[int] = collections.Counter()
        self._second: int | None = None

    def allows(self, user: int) -> bool:
        """Return whether acks of a user may be accepted at all."""
        return not self._allowed or any(user in numbers for numbers in self._allowed)

    def within_rate(self, user: int, now_s: float) -> bool:
        """Return whether another ack of a user is within the rate.

        Parameters
        ----------
        now_s
            Time on any monotonic clock [s].
        """
        counted = self._acks[user] if math.floor(now_s) == self._second else 0
        return counted + 1 <= self._rate_hz

    def count(self, user: int, now_s: float) -> None:
        """Count an ack of a user, at a time on the clock of `within_rate` [s]."""
        second = math.floor(now_s)
        if second != self._second:
            self._second = second
            self._acks.clear()
        self._acks[user] += 1


def parse_users(text: str) -> tuple[range, ...]:
    """Parse a list of users, such as ``1, 4, 10-20``.

    Parameters
    ----------
    text
        User numbers from 1 and ranges, separated by commas; may be empty.

    Raises
    ------
    ValueError
        If a part is neither a number nor an ascending range.
    """
    return tuple(_parse_range(part) for part in text.split(',')) if text.strip() else ()


def _parse_range(part: str) -> range:
    match = _RANGE.fullmatch(part)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
    if not 1 <= first <= last <= _LAST_USER:
        raise ValueError(f'{part.strip()!r}, expected numbers from 1 to {_LAST_USER} and ranges '
                         'such as 10-20')
    return range(first, last + 1)
