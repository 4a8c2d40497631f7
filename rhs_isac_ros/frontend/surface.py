"""The interface of a surface, real or emulated, that shows one configuration after another."""

from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from rhs_isac_ros.model.arrays import numbers

FaultKind = Literal['silence', 'garbled', 'mismatch', 'stray', 'restart', 'closed', 'occupied']


class SurfaceFault(Exception):
    """A surface does not show a configuration, or it is unknown which one it shows.

    Attributes
    ----------
    kind : str
        One of `FaultKind`, for example as key of a line in a log.
        ``silence``: no answer in time. ``garbled``: another answer than expected. ``mismatch``:
        the surface reports another configuration. ``stray``: a message that no command asked for,
        such as a late answer. ``restart``: the surface has restarted, and lost its configuration.
        ``closed``: the connection is closed or cannot be opened. ``occupied``: another process
        uses the connection.
    """

    def __init__(self, kind: FaultKind, text: str) -> None:
        super().__init__(text)
        self.kind = kind


@runtime_checkable
class Surface(Protocol):
    """A surface whose elements have adjustable tunings."""

    @property
    def n_elements(self) -> int:
        """Number of elements."""
        ...

    @property
    def waits(self) -> bool:
        """Whether `apply` and `close` wait for hardware, so that they need a thread."""
        ...

    def apply(self, configuration: ArrayLike) -> None:
        """Show a configuration, [n_elements], and return when the surface has confirmed it.

        It contains a tuning in [0, 1] for each element, in the order of `element_positions`. With
        L `amplitude_levels`, the tuning of the level or state n, from 0, is n / (L - 1). Raises
        ValueError if the surface cannot show such a configuration, and SurfaceFault if it does not
        confirm it. After a fault, the next call tries again, without a restart.
        """
        ...

    def close(self) -> None:
        """Release the connection; the next call of `apply` opens it again."""
        ...


class EmulatedSurface:
    """A surface without hardware: `apply` always succeeds, and `applied` is what it shows."""

    waits = False

    def __init__(self, n_elements: int) -> None:
        self.n_elements = n_elements
        self.applied = np.zeros(n_elements)

    def apply(self, configuration: ArrayLike) -> None:
        """Show a configuration, tunings from 0 to 1."""
        self.applied = checked(configuration, self.n_elements)

    def close(self) -> None:
        """Do nothing, as there is no connection."""


def checked(configuration: ArrayLike, n_elements: int, is_binary: bool = False) -> np.ndarray:
    """Return a copy of a configuration, float64 [n_elements], or raise ValueError.

    Its tunings are from 0 to 1, or either of them if `is_binary` is set.
    """
    values = np.array(numbers('configuration', configuration, shapes=[(n_elements,)]))
    is_valid = (values == 0) | (values == 1) if is_binary else (0 <= values) & (values <= 1)
    if not is_valid.all():
        element = int(np.argmin(is_valid))
        raise ValueError(f'configuration[{element}]: {values[element]:g}, expected 0 '
                         f'{"or" if is_binary else "to"} 1')
    return values
