"""What the trials of the network look like on paper."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from rhs_isac_ros.monitoring.invariants import InvariantChecker
from system.chaos.crashes import Cell
from system.chaos.fuzzing import Fuzzed
from system.chaos.soaking import Soaked

CRASH_HEAD = (
    'killed          in phase       recovered   others   told by (log; diagnostics)')


def crash_line(cell: Cell) -> str:
    """Write a trial as a row of the table.

    Parameters
    ----------
    cell
        The trial.

    Returns
    -------
    str
        The row.
    """
    speakers = sorted({line.partition(':')[0] for line in cell.told_log})
    told = f'{", ".join(speakers) or "-"}; {", ".join(cell.told_diagnostics) or "-"}'
    others = 'alive' if cell.survivors else 'DIED'
    mark = ('' if cell.recovered else '  NOT IN TIME') + ('' if cell.told else '  NOT TOLD ONCE')
    row = (f'{cell.node:15s} {cell.phase:14s} {cell.recovered_s:7.2f} s   {others:6s}   '
           f'{told}{mark}')
    return '\n'.join([row, *(f'  WRONG: {fault}' for fault in cell.broken)])


def crash_figures(cells: Sequence[Cell], promises: InvariantChecker) -> dict:
    """Sum the trials up.

    Parameters
    ----------
    cells
        The trials.
    promises
        The watch over the results of the whole run.

    Returns
    -------
    dict
        Figures for people and programs.
    """
    recovered = sum(cell.recovered for cell in cells)
    worst_s = max((cell.recovered_s for cell in cells), default=0.0)
    return {
        'cells': len(cells),
        'cells_recovered': recovered,
        'cells_told': sum(cell.told for cell in cells),
        'worst_recovery_s': worst_s if math.isfinite(worst_s) else None,
        'wrong_publications': len(promises.broken),
        'checked_publications': promises.checked,
        'unverified_publications': promises.unverified,
        'table': [{'node': cell.node, 'phase': cell.phase,
                   'recovered_s': cell.recovered_s if math.isfinite(cell.recovered_s) else None,
                   'others_alive': cell.survivors, 'told_log': list(cell.told_log),
                   'told_diagnostics': list(cell.told_diagnostics),
                   'wrong': list(cell.broken)} for cell in cells],
        'passed': (all(cell.recovered and cell.told for cell in cells)
                   and not promises.broken),
    }


def crash_summary(figures: dict) -> str:
    """Write the sum of all trials.

    Parameters
    ----------
    figures
        As `crash_figures` returns them.

    Returns
    -------
    str
        One line.
    """
    worst_s = figures['worst_recovery_s']
    worst = 'never' if worst_s is None else f'{worst_s:.2f} s'
    return (f'{figures["cells_told"]} of {figures["cells"]} told of once; '
            f'{figures["cells_recovered"]} of {figures["cells"]} recovered within the limit, '
            f'the slowest in {worst}; {figures["wrong_publications"]} wrong publications among '
            f'{figures["checked_publications"]}, {figures["unverified_publications"]} of which '
            'were made before this watcher found a node that others had found already')


def soak_figures(soaked: Soaked, promises: InvariantChecker) -> dict:
    """Sum a long run up.

    Parameters
    ----------
    soaked
        The run.
    promises
        The watch over its results.

    Returns
    -------
    dict
        Figures for people and programs.
    """
    return {
        **dataclasses.asdict(soaked),
        'cycles': soaked.cycles,
        'estimate_share': soaked.share,
        'memory_growth': soaked.growth,
        'worst_memory_growth': max(soaked.growth.values(), default=0.0),
        'wrong_publications': len(promises.broken),
        'checked_publications': promises.checked,
        'wrong': promises.broken,
        'passed': soaked.passed and not promises.broken,
    }


def soak_text(soaked: Soaked, figures: dict) -> str:
    """Write a long run as lines.

    Parameters
    ----------
    soaked
        The run.
    figures
        As `soak_figures` returns them.

    Returns
    -------
    str
        The lines.
    """
    lines = [
        f'{soaked.minutes:.1f} minutes, {soaked.cycles} cycles, '
        f'{100 * soaked.share:.2f} % of which led to an estimate',
        f'the air: {_counts(soaked.air)}',
        f'cycles: {_counts(soaked.outcomes)}',
        f'asked for again: {_counts(soaked.retries)}',
        f'{figures["wrong_publications"]} wrong publications among '
        f'{figures["checked_publications"]}',
        'memory, after the first minute and at the end [MiB]:']
    lines += [f'  {name:15s} {first / 2**20:7.1f} {last / 2**20:7.1f}   {100 * growth:+5.2f} %'
              for (name, (first, last)), growth in zip(
                  soaked.memory_bytes.items(), soaked.growth.values(), strict=True)]
    lines += [f'ENDED: {name}' for name in soaked.ended]
    return '\n'.join([*lines, *(f'WRONG: {fault}' for fault in figures['wrong'])])


def fuzz_figures(fuzzed: Fuzzed) -> dict:
    """Sum the lies up.

    Parameters
    ----------
    fuzzed
        What became of them.

    Returns
    -------
    dict
        Figures for people and programs.
    """
    again_s = fuzzed.serves_again_s
    return {**dataclasses.asdict(fuzzed), 'lies': sum(fuzzed.sent.values()),
            'serves_again_s': again_s if math.isfinite(again_s) else None,
            'passed': fuzzed.passed}


def fuzz_text(fuzzed: Fuzzed) -> str:
    """Write what became of the lies as lines.

    Parameters
    ----------
    fuzzed
        What became of them.

    Returns
    -------
    str
        The lines.
    """
    lines = [f'{sum(fuzzed.sent.values())} lies on {len(fuzzed.sent)} topics; '
             f'{len(fuzzed.ended)} processes ended, {len(fuzzed.traces)} error traces',
             'malformed, by node, as sent and as counted:']
    lines += [f'  {node:15s} {n:7d} {fuzzed.counted[node]:7d}'
              for node, n in sorted(fuzzed.malformed.items())]
    lines += [f'dropped, by reason: {_counts(fuzzed.dropped)}',
              f'serves both users again {fuzzed.serves_again_s:.1f} s after the last one']
    return '\n'.join([*lines, *(f'ENDED: {name}' for name in fuzzed.ended),
                      *(f'TRACE: {line}' for line in fuzzed.traces)])


def _counts(counts: Mapping[str, int]) -> str:
    return ', '.join(f'{name} {n}' for name, n in sorted(counts.items()) if n) or 'nothing'
