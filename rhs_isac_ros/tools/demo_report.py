"""Report of the demonstration: a table of the cycles and a summary."""

import math
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.monitoring.cycle_log import CompleteCycle, CycleRecord
from rhs_isac_ros.protocol.messages import Phase

_PHASES = (Phase.BEACONING, Phase.POSITIONING, Phase.ESTIMATING, Phase.TRANSMITTING)


def table(cycles: Sequence[CompleteCycle]) -> str:
    """Return a table with one line for each cycle."""
    head = ('cycle user  true position [m]      estimate [m]           error  '
            '√CRLB   beacon   sound  locate    data   capacity     loss\n'
            '                                                            [m]    '
            '[m]     [ms]    [ms]    [ms]    [ms]   [Mbit/s]      [%]')
    return '\n'.join([head, *(_row(cycle) for cycle in cycles)])


def _row(cycle: CompleteCycle) -> str:
    durations = cycle.durations_s()
    times = ''.join(f'{1e3 * durations.get(phase, math.nan):8.1f}' for phase in _PHASES)
    return (f'{cycle.cycle_id:5d} {cycle.user:4d}  {_coordinates(cycle.truth.position):22s}'
            f' {_coordinates(cycle.estimate.position):22s}{cycle.error_m:6.2f} '
            f'{math.sqrt(cycle.estimate.crlb_m2):6.2f} {times}'
            f' {cycle.capacity.actual_bps / 1e6:10.3f} {cycle.capacity.loss_percent:8.3f}')


def _coordinates(position: np.ndarray) -> str:
    return ' '.join(f'{coordinate:6.2f}' for coordinate in position)


def summary(cycles: Sequence[CompleteCycle], given_up: Sequence[CycleRecord]) -> str:
    """Return statistics of at least one complete cycle, and a line for each that was given up."""
    errors = np.array([cycle.error_m for cycle in cycles])
    bounds = np.sqrt([cycle.estimate.crlb_m2 for cycle in cycles])
    lengths = np.array([cycle.duration_s for cycle in cycles])
    losses = np.array([cycle.capacity.loss_percent for cycle in cycles])
    users = len({cycle.user for cycle in cycles})
    lines = [
        f'{len(cycles)} cycles of {users} users served, {len(given_up)} given up',
        f'position error: median {np.median(errors):.2f} m, root mean square '
        f'{np.sqrt(np.mean(errors**2)):.2f} m; median √CRLB {np.median(bounds):.2f} m',
        f'cycle: median {1e3 * np.nanmedian(lengths):.1f} ms; estimator: median '
        f'{1e3 * np.median([cycle.estimate.latency_s for cycle in cycles]):.1f} ms',
        f'capacity: median {np.median([c.capacity.actual_bps for c in cycles]) / 1e6:.2f} '
        f'Mbit/s; loss: median {np.median(losses):.3f} %, worst {losses.max():.3f} %']
    lines += [f'cycle {record.cycle_id} of user {record.user} given up: {record.outcome}'
              for record in given_up]
    return '\n'.join(lines)
