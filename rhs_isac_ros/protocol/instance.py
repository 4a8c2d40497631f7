"""Instances of nodes, identified by the time at which they started."""

import datetime


def started(instance: int) -> str:
    """Return the start of an instance [ns since 1970] for a log message."""
    time = datetime.datetime.fromtimestamp(instance // 10**9, datetime.timezone.utc)
    return f'started {time:%Y-%m-%d %H:%M:%S} UTC'
