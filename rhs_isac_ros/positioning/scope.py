"""Where modes are searched for: the region, or the part of it that a prior covers."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.alternatives import Alternative
from rhs_isac_ros.positioning.grid import Draw, TemplateTable
from rhs_isac_ros.positioning.lattice import Grid
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.moving import MovingTable
from rhs_isac_ros.positioning.offsets import Alignment


class SearchScope(NamedTuple):
    """Where modes are searched for, and what depends on the templates there."""

    table: TemplateTable
    alignment: Alignment
    alternatives: Sequence[Alternative]
    #: Cells in which less likely modes are kept as well, bool [C] or [1].
    favoured: np.ndarray
    drawn: Draw | None = None

    @classmethod
    def of(cls, likelihood: Likelihood, arrays: Mapping[str, np.ndarray], grid: Grid,
           alternatives: Sequence[Alternative]) -> 'SearchScope':
        """Take the templates of a grid, which may be part of the region's."""
        scenario = likelihood.scenario
        kind = MovingTable if scenario.user_speed_std_mps else TemplateTable
        table = kind(scenario, arrays, grid=grid)
        return cls(table, Alignment(likelihood, table.spread), alternatives, np.zeros(1, bool))
