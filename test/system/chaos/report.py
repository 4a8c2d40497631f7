"""Results of the chaos trials as lines and as JSON figures."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from system.chaos.crashes import CrashTrial
from system.chaos.fuzzing import FuzzResult
from system.chaos.intruders import IntrusionTrial
from system.chaos.soaking import SoakResult
from system.chaos.trial import Trial
from system.invariants import InvariantChecker
from system.recovery import finite

CRASH_HEAD = (
    'killed          in phase       recovered   others   reported by (log; diagnostics)')


def crash_line(trial: CrashTrial) -> str:
    """Return a trial as a row of the table, followed by its violations."""
    return _row(f'{trial.node:15s} {trial.phase:14s}', trial)


def trial_figures(trials: Sequence[Trial], invariants: InvariantChecker) -> dict[str, Any]:
    """Return the figures of all trials, for JSON."""
    worst_s = max((trial.recovery_s for trial in trials), default=0.0)
    return {
        'trials': len(trials),
        'trials_recovered': sum(trial.recovered for trial in trials),
        'trials_reported': sum(trial.reported for trial in trials),
        'worst_recovery_s': finite(worst_s),
        'wrong_publications': len(invariants.violations),
        'checked_publications': invariants.checked,
        'unverified_publications': invariants.unverified,
        'table': [{**dataclasses.asdict(trial), 'recovery_s': finite(trial.recovery_s)}
                  for trial in trials],
        'passed': (all(trial.recovered and trial.reported for trial in trials)
                   and not invariants.violations),
    }


def trial_summary(kind: str, trials: Sequence[Trial]) -> str:
    """Return a line about the trials of one kind."""
    worst_s = max((trial.recovery_s for trial in trials), default=0.0)
    worst = f'{worst_s:.2f} s' if math.isfinite(worst_s) else 'never'
    return (f'{kind}: {sum(trial.reported for trial in trials)} of {len(trials)} reported once; '
            f'{sum(trial.recovered for trial in trials)} of {len(trials)} recovered within the '
            f'limit, slowest: {worst}')


def publication_summary(figures: Mapping[str, Any]) -> str:
    """Return one line about the publications that `trial_figures` counted."""
    return (f'{figures["wrong_publications"]} wrong publications among '
            f'{figures["checked_publications"]}, {figures["unverified_publications"]} of which '
            'preceded the discovery of a node by the observer')


INTRUSION_HEAD = (
    'intruder         served   recovered   others   reported by (log; diagnostics)')


def intrusion_line(trial: IntrusionTrial) -> str:
    """Return a trial as a row of the table, followed by its violations."""
    return _row(f'{trial.intruder:15s} {trial.served:7d}', trial)


def _row(first: str, trial: Trial) -> str:
    """Return the first columns and the columns of all trials, followed by the violations."""
    loggers = sorted({line.partition(':')[0] for line in trial.logged})
    reporters = f'{", ".join(loggers) or "-"}; {", ".join(trial.diagnosed) or "-"}'
    others = 'running' if trial.others_running else 'ENDED'
    marks = ('' if trial.recovered else '  NOT IN TIME') + (
        '' if trial.reported else '  NOT REPORTED ONCE')
    row = f'{first} {trial.recovery_s:7.2f} s   {others:7s}  {reporters}{marks}'
    return '\n'.join([row, *(f'  VIOLATION: {text}' for text in trial.violations)])


def soak_figures(result: SoakResult, invariants: InvariantChecker) -> dict[str, Any]:
    """Return the figures of a soak test, for JSON."""
    return {
        **dataclasses.asdict(result),
        'cycles': result.cycles,
        'estimate_share': result.estimate_share,
        'memory_growth': result.memory_growth,
        'worst_memory_growth': max(result.memory_growth.values(), default=0.0),
        'wrong_publications': len(invariants.violations),
        'checked_publications': invariants.checked,
        'violations': invariants.violations,
        'passed': result.passed and not invariants.violations,
    }


def fuzz_figures(result: FuzzResult) -> dict[str, Any]:
    """Return the figures of fuzzing, for JSON."""
    return {**dataclasses.asdict(result), 'mutations': sum(result.sent.values()),
            'recovery_s': finite(result.recovery_s), 'passed': result.passed}
