"""Rows, conditions and results of Fig. 4."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from parts.frame import CONFIG

from rhs_isac_ros.codebook import Codebook, directional_codebook, random_codebook
from rhs_isac_ros.experiments.resampling import Replicates, replicate
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams

NEURAL = 'neural'
# Rows whose codebook differs between trials.
DRAWN = ('algorithm-1', 'random')
SCANS = {'scan-width': 'width', 'scan-per-band': 'width_per_band', 'scan-grid': 'grid'}
ROWS = ('algorithm-1', 'crlb', 'ambiguity', *SCANS, 'random')
QUARTILES = (0.25, 0.5, 0.75)


def codebook_of(row: str, scenario: Scenario, trial: int) -> Codebook:
    """Return the codebook of a row that needs no optimisation."""
    if row in SCANS:
        return directional_codebook(scenario, scan=SCANS[row])
    if row == 'random':
        return random_codebook(scenario, streams.generator(trial, streams.START))
    return Codebook.load(CONFIG / f'codebook_{row}.yaml')


class Condition(NamedTuple):
    """An estimator, the inputs of the network, and the level of the multipath [dB]."""

    estimator: str
    inputs: str
    level_db: float

    @property
    def slug(self) -> str:
        """Name for files."""
        return '-'.join([self.inputs or self.estimator, f'{self.level_db:+g}dB'])

    def __str__(self) -> str:
        """Return the name for tables."""
        inputs = {'parts': 'network, re/im', 'magnitudes': 'network, magnitudes'}
        return f'{inputs.get(self.inputs, self.estimator)}, {self.level_db:g} dB'

    def trials(self, row: str, trials: int) -> int:
        """Return the number of trials of a row; without training and drawing, all are equal."""
        return trials if self.estimator == NEURAL or row in DRAWN else 1


class Results:
    """Estimates and capacity losses of all conditions and rows.

    Attributes
    ----------
    truth
        True positions, float64 [N, 3] [m].
    estimates
        Estimates of the trials, NaN where a trial serves no position, float64 [trials, N, 3] [m].
    validation_m2
        Validation errors of the trainings [m^2].
    losses
        Capacity losses [bit/s], of the trial that serves a position, float64 [trials, n].
    without_fix
        Number of positions without a fix.
    """

    def __init__(self, truth: np.ndarray) -> None:
        self.truth = truth
        self.estimates: dict[tuple[Condition, str], np.ndarray] = {}
        self.validation_m2: dict[tuple[Condition, str], list[float]] = {}
        self.losses: dict[tuple[Condition, str], np.ndarray] = {}
        self.without_fix: dict[tuple[Condition, str], int] = {}
        self._statistics: dict[tuple[Condition, str], Mapping[str, Replicates]] = {}

    def add(self, condition: Condition, row: str, result: Mapping[str, Any], first: int,
            step: int) -> None:
        """Add the estimates of a trial for every `step`-th position."""
        key = condition, row
        means = np.full((1, *self.truth.shape), np.nan)
        means[0, first::step] = result['means']
        known = self.estimates.get(key, means[:0])
        self.estimates[key] = np.concatenate([known, means])
        self.validation_m2.setdefault(key, []).append(result['validation_mse_m2'])
        self.without_fix[key] = self.without_fix.get(key, 0) + result['without_fix']

    def add_losses(self, condition: Condition, row: str, losses: Sequence[float]) -> None:
        """Add the losses of the first positions with the estimates of `best_estimates`."""
        trials = self._serving(condition, row)[:len(losses)]
        served = np.full((trials.max() + 1, len(losses)), np.nan)
        served[trials, np.arange(len(losses))] = losses
        self.losses[condition, row] = served[np.isfinite(served).any(axis=1)]

    @property
    def conditions(self) -> list[Condition]:
        """Return the conditions in the order in which they were added."""
        return list(dict.fromkeys(condition for condition, _ in self.estimates))

    @property
    def rows(self) -> list[str]:
        """Return the rows in the order in which they were added."""
        return list(dict.fromkeys(row for _, row in self.estimates))

    def errors_m2(self, condition: Condition, row: str) -> np.ndarray:
        """Return the squared errors, float64 [trials, N] [m^2]."""
        return np.sum(
            (self.estimates[condition, row] - self.truth)**2, axis=-1)

    def best_estimates(self, condition: Condition, row: str) -> np.ndarray:
        """Return the estimates for panel (b), float64 [N, 3] [m]."""
        trials = self._serving(condition, row)
        return self.estimates[condition, row][trials, np.arange(len(trials))]

    def _serving(self, condition: Condition, row: str) -> np.ndarray:
        """Return the trial that serves each position in panel (b)."""
        n_trials, n, _ = self.estimates[condition, row].shape
        if row in DRAWN:
            return np.arange(n) % n_trials
        return np.full(n, np.argmin(self.validation_m2[condition, row]))

    def statistics(self, condition: Condition, row: str) -> Mapping[str, Replicates]:
        """Return mean error, median and interquartile range of the loss, with replicates."""
        key = condition, row
        if key not in self._statistics:
            # The same in every run, and different for all conditions and rows.
            seed = zlib.crc32(f'{condition.slug} {row}'.encode())
            values = {'error': replicate(self.errors_m2(*key), seed)[0]}
            if key in self.losses:
                low, middle, high = replicate(self.losses[key], seed, QUARTILES)
                values |= {'median loss': middle, 'range of the loss': high.minus(low)}
            self._statistics[key] = values
        return self._statistics[key]
