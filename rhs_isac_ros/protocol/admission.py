"""The acks that a base station accepts: the numbers of users, and the rate of their acks."""

import collections
import math
import re

from rhs_isac_ros.protocol import messages as m

_RANGE = re.compile(r'\s*(\d+)\s*(?:-\s*(\d+)\s*)?')


def parse_users(text: str) -> tuple[range, ...]:
    """Parse a possibly empty list of user numbers and ranges, such as ``1, 4, 10-20``.

    Raises ValueError if a part is not a number from 1 to `LAST_USER` or an ascending range.
    """
    return tuple(_parse_range(part) for part in text.split(',')) if text.strip() else ()


def _parse_range(part: str) -> range:
    match = _RANGE.fullmatch(part)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
    if not 1 <= first <= last <= m.LAST_USER:
        raise ValueError(f'{part.strip()!r}, expected numbers from 1 to {m.LAST_USER} and ranges '
                         'such as 10-20')
    return range(first, last + 1)


class Admission:
    """The limits on the numbers of users, as in `parse_users`, and on the rate of their acks."""

    def __init__(self, allowed_users: str, max_users: int, rate_hz: float) -> None:
        self._max_users, self._rate_hz = max_users, rate_hz
        self._allowed = parse_users(allowed_users) or (range(m.LAST_USER + 1),)
        # Number of acks by user in the current second; cleared each second, to bound the memory.
        self._acks: collections.Counter[int] = collections.Counter()
        self._second = 0

    def allows(self, user: int) -> bool:
        """Return whether the number of a user is within the limits."""
        return user <= self._max_users and any(user in users for users in self._allowed)

    def exceeds_rate(self, user: int, now_s: float) -> bool:
        """Return whether another ack of a user is one too many in the current second."""
        counted = self._acks[user] if math.floor(now_s) == self._second else 0
        return counted + 1 > self._rate_hz

    def count(self, user: int, now_s: float) -> None:
        """Count an ack."""
        second = math.floor(now_s)
        if second != self._second:
            self._second = second
            self._acks.clear()
        self._acks[user] += 1
