"""Lists of users in texts."""

from collections.abc import Iterable

# Maximum number of users that one text names.
MAX_NAMED = 8


def join_users(users: Iterable[int]) -> str:
    """Return the numbers of users as a list, which ends with a count of those beyond `MAX_NAMED`.

    Examples
    --------
    >>> join_users(range(1, 12))
    '1, 2, 3, 4, 5, 6, 7, 8 and 3 others'
    """
    names = [str(user) for user in users]
    n_others = len(names) - MAX_NAMED
    others = f' and {n_others} other{"s" * (n_others > 1)}' if n_others > 0 else ''
    return f'{", ".join(names[:MAX_NAMED])}{others}'
