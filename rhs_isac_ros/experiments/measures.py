"""The measures of a sweep: statistics over positions, with their intervals."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.experiments.resampling import replicate, share_percent
from rhs_isac_ros.model.threads import one_blas_thread

# Larger than every finite result; its square root and its half remain finite.
_INFINITE = 1e300


class Measure(NamedTuple):
    """A statistic of one quantity over the positions.

    Attributes
    ----------
    quantity
        Name of the quantity, of which a position has one value.
    label
        Label of an axis without the unit.
    unit
        Unit of the measure.
    quantile
        The quantile, from 0 to 1; None for the mean.
    root
        Whether the measure is the square root of the statistic.
    share
        Whether the quantity is 0 or 1 and the measure its share in per cent.
    """

    quantity: str
    label: str
    unit: str
    quantile: float | None = None
    root: bool = False
    share: bool = False


MEASURES: Mapping[str, Measure] = {
    'crlb': Measure('crlb_m2', 'average CRLB', 'm²'),
    'crlb_median': Measure('crlb_m2', 'median CRLB', 'm²', 0.5),
    'crlb_p95': Measure('crlb_m2', 'CRLB, 95th percentile', 'm²', 0.95),
    'root_crlb': Measure('crlb_m2', 'root of the average CRLB', 'm', root=True),
    'global_bound': Measure('bound_m2', 'global bound', 'm²'),
    'root_global_bound': Measure('bound_m2', 'root of the global bound', 'm', root=True),
    'mse': Measure('squared_error_m2', 'mean squared error', 'm²'),
    'rmse': Measure('squared_error_m2', 'root mean squared error', 'm', root=True),
    'error_median': Measure('squared_error_m2', 'median error', 'm', 0.5, root=True),
    'error_p95': Measure('squared_error_m2', 'error, 95th percentile', 'm', 0.95, root=True),
    'coverage': Measure('inside', 'coverage of the 95 % region', '%', share=True),
    'fixes': Measure('fix', 'positions with a fix', '%', share=True),
    'capacity': Measure('capacity_bps', 'capacity', 'bit/s'),
    'capacity_perfect': Measure('perfect_bps', 'capacity, position known', 'bit/s'),
    'capacity_loss': Measure('loss_bps', 'capacity loss', 'bit/s'),
    'capacity_loss_median': Measure('loss_bps', 'median capacity loss', 'bit/s', 0.5),
    'capacity_loss_p95': Measure('loss_bps', 'capacity loss, 95th percentile', 'bit/s', 0.95),
}


class Interval(NamedTuple):
    """A value and the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@one_blas_thread
def measured(measure: Measure, results: np.ndarray) -> Interval:
    """Return a measure of results, float64 [codebooks, positions], with its interval.

    The interval is that of the bootstrap over codebooks and positions. A share of a single
    codebook or of equal results has the interval of Wilson, because the bootstrap of equal
    results has no width. The value is NaN if a result is, and the interval of an infinite mean
    is NaN.
    """
    if np.isnan(results).any():
        return Interval(np.nan, np.nan, np.nan)
    if measure.share and (len(results) == 1 or np.ptp(results) == 0):
        # Codebooks share their positions, so that they do not count as further samples.
        return Interval(*share_percent(int(results[0].sum()), len(results[0])))
    if measure.quantile is None and np.isinf(results).any():
        return Interval(np.inf, np.nan, np.nan)
    finite = np.minimum(results, _INFINITE)
    (replicates,) = replicate(finite, 0, () if measure.quantile is None else [measure.quantile])
    ends = np.array(replicates.interval())
    if measure.quantile is None:
        # The replicates have single precision, fewer digits than the table of a sweep.
        ends[0] = results.mean()
    ends = np.where(ends > _INFINITE / 2, np.inf, ends)
    if measure.root:
        ends = np.sqrt(np.maximum(ends, 0.0))
    if measure.share:
        ends = 100 * np.clip(ends, 0.0, 1.0)
    return Interval(*ends.tolist())


def parse_measures(text: str) -> list[list[str]]:
    """Parse ``NAME,...``, where ``+`` joins measures of one unit that share a panel.

    Raises
    ------
    ValueError
        If a measure is unknown, occurs twice, or has another unit than those it is joined to.
    """
    panels = [panel.split('+') for panel in text.split(',')]
    names = names_of(panels)
    for name in names:
        if name not in MEASURES:
            raise ValueError(f'{name!r}, expected one of {", ".join(MEASURES)}')
        if names.count(name) > 1:
            raise ValueError(f'{name} more than once, expected different measures')
    for panel in panels:
        for name in panel:
            if MEASURES[name].unit != MEASURES[panel[0]].unit:
                raise ValueError(
                    f'{name} [{MEASURES[name].unit}] joined to {panel[0]}, expected a measure in '
                    f'{MEASURES[panel[0]].unit}')
    return panels


def names_of(panels: Iterable[Iterable[str]]) -> list[str]:
    """Return the names of the measures of all panels."""
    return [name for panel in panels for name in panel]
