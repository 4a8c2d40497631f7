"""Cycles as a table, as a summary and as a picture."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.monitoring.cycle_log import CycleRecord
from rhs_isac_ros.protocol.messages import Phase
from rhs_isac_ros.tools.ellipses import ellipse_95

_PHASES = (Phase.BEACONING, Phase.POSITIONING, Phase.ESTIMATING, Phase.TRANSMITTING)


def table(cycles: Sequence[CycleRecord]) -> str:
    """Write one line for each cycle.

    Parameters
    ----------
    cycles
        Complete cycles.

    Returns
    -------
    str
        The table, with its head.
    """
    head = ('cycle user  true position [m]      estimate [m]           error  '
            '√CRLB   beacon   sound  locate    data   capacity     loss\n'
            '                                                            [m]    '
            '[m]     [ms]    [ms]    [ms]    [ms]   [Mbit/s]      [%]')
    return '\n'.join([head, *(_row(record) for record in cycles)])


def _row(record: CycleRecord) -> str:
    durations = record.durations_s()
    times = ''.join(f'{1e3 * durations.get(phase, math.nan):8.1f}' for phase in _PHASES)
    return (f'{record.cycle_id:5d} {record.user:4d}  {_place(record.truth.position):22s}'
            f' {_place(record.estimate.position):22s}{record.error_m:6.2f} '
            f'{math.sqrt(record.estimate.crlb_m2):6.2f} {times}'
            f' {record.capacity.actual_bps / 1e6:10.3f} {record.capacity.loss_percent:8.3f}')


def _place(position: np.ndarray) -> str:
    return ' '.join(f'{coordinate:6.2f}' for coordinate in position)


def summary(cycles: Sequence[CycleRecord], given_up: Sequence[CycleRecord]) -> str:
    """Write what the cycles have in common.

    Parameters
    ----------
    cycles
        Complete cycles, at least one.
    given_up
        Cycles that were not served.

    Returns
    -------
    str
        Some lines.
    """
    errors = np.array([record.error_m for record in cycles])
    bounds = np.sqrt([record.estimate.crlb_m2 for record in cycles])
    lengths = np.array([record.ended_s - record.began_s for record in cycles])
    losses = np.array([record.capacity.loss_percent for record in cycles])
    users = len({record.user for record in cycles})
    lines = [
        f'{len(cycles)} cycles of {users} users served, {len(given_up)} given up',
        f'error: median {np.median(errors):.2f} m, root mean square '
        f'{np.sqrt(np.mean(errors**2)):.2f} m; median √CRLB {np.median(bounds):.2f} m',
        f'cycle: median {1e3 * np.nanmedian(lengths):.1f} ms; estimator: median '
        f'{1e3 * np.median([r.estimate.latency_s for r in cycles]):.1f} ms',
        f'capacity: median {np.median([r.capacity.actual_bps for r in cycles]) / 1e6:.2f} '
        f'Mbit/s; loss: median {np.median(losses):.3f} %, worst {losses.max():.3f} %']
    lines += [f'cycle {r.cycle_id} of user {r.user} given up: {r.outcome}' for r in given_up]
    return '\n'.join(lines)


def draw(cycles: Sequence[CycleRecord], scenario: Scenario, path: Path) -> None:
    """Draw the region of interest from above, with true positions and estimates.

    Parameters
    ----------
    cycles
        Complete cycles.
    scenario
        The scenario.
    path
        PNG file to write.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    # Here: a slow import that only the picture needs.
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt
    from matplotlib.patches import Ellipse, Rectangle

    figure, axes = plt.subplots(figsize=(8, 7), layout='constrained')
    low, high = scenario.roi_bounds_m
    axes.add_patch(Rectangle(low[:2], *(high - low)[:2], fill=False, linestyle='--', color='0.5',
                             label='region of interest'))
    board = element_positions(scenario)
    axes.plot(board[:, 0], board[:, 1], linewidth=5, color='black', label='surface')
    for user in sorted({record.user for record in cycles}):
        color = f'C{(user - 1) % 10}'
        own = [record for record in cycles if record.user == user]
        truth = np.array([record.truth.position for record in own])
        mean = np.array([record.estimate.position for record in own])
        axes.plot(truth[:, 0], truth[:, 1], 'o', color=color, label=f'user {user}')
        axes.plot(mean[:, 0], mean[:, 1], 'x', color=color, label=f'user {user}, estimate')
        axes.plot([truth[:, 0], mean[:, 0]], [truth[:, 1], mean[:, 1]], color=color,
                  linewidth=0.7)
        for record in own:
            width, height, angle = ellipse_95(record.estimate.covariance_m2[:2, :2])
            axes.add_patch(Ellipse(record.estimate.position[:2], width, height, angle=angle,
                                   fill=False, color=color, alpha=0.4))
    axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal',
             title=f'{len(cycles)} cycles from above; ellipses hold 95 % of the posterior')
    axes.set_xlim(left=min(-1.0, low[0] - 1))
    axes.legend(loc='upper left', fontsize='small')
    figure.savefig(path, dpi=120)
    plt.close(figure)
