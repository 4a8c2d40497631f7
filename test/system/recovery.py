"""The time to recover, for both kinds of trials."""

import math

# Maximum time to recover [s].
RECOVERY_LIMIT_S = 3.0


def finite(time_s: float) -> float | None:
    """Return a time, or None for JSON if it is infinite."""
    return time_s if math.isfinite(time_s) else None
