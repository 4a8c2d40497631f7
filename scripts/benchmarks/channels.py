"""Positioning on channels that a ray tracer computed, before and after a survey of the hall.

Problem: the estimator assumes Gaussian multipath that three fields of the scenario declare, and a
hall has walls. What do positions at known places teach it? Signals follow the traced paths of
users in an empty hall and in one with reflections; other users of the same hall are the survey.
`calibration.survey` estimates the covariance of the multipath from 10 to 300 of these, drawn
several times, each time with other thermal noise in all signals. The 95 % region of an estimate is
the ellipsoid of its covariance that contains 95 % of a Gaussian. Shares have Wilson's 95 %
intervals over the users; of several surveys, the table lists the mean, and the range of the share
in the region.

The folder contains empty_test.npz, hall_test.npz and hall_survey.npz with propagation paths.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import dataclasses
import json
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from rhs_isac_ros.calibration import SurveyWarning, survey
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import Scenario, ScenarioError, simulate_received
from rhs_isac_ros.model.arguments import ArgumentParser, output_file, positive_int, seed
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.positioning import make_estimator

ROOT = Path(__file__).parents[2]
SYSTEMS = {'table1': ('table1.yaml', 'codebook.yaml'),
           'bandplan': ('bandplan.yaml', 'codebook_bandplan.yaml')}
REGION_RADIUS = float(chi2.ppf(0.95, 3))


class Result(NamedTuple):
    """Numbers of users, of fixes and of those in the 95 % region, and the error of the fixes."""

    n: int
    fixes: int
    inside: int
    rms_m: float

    @property
    def shares(self) -> dict[str, float]:
        """Shares of users with a fix, and of fixes in the region, and the error."""
        return {'fix': self.fixes / self.n, 'in_region': self.inside / max(self.fixes, 1),
                'rms_m': self.rms_m}


def main() -> None:
    """Run the benchmark."""
    parser = ArgumentParser(
        prog='scripts/benchmark channels', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add('folder', type=Path, nargs='?', default=ROOT.parent / 'shared' / 'channels',
        help='folder of the channel files (default: ../shared/channels of the repository)')
    add('--surveys', type=positive_int, default=5,
        help='random surveys of each size (default: %(default)s)')
    add('--positions', type=positive_int, nargs='+', default=[10, 30, 100, 300],
        help='sizes of the surveys (default: 10 30 100 300)')
    add('--seed', type=seed, default=1, help='seed of all random numbers (default: %(default)s)')
    add('--json', type=output_file, help='JSON file for the results')
    options = parser.parse_args()
    print('| hall | system | survey | fix [%] | in the 95 % region [%] | range over surveys [%] | '
          'rms error [m] |\n|---|---|---|---|---|---|---|')
    figures: dict[str, dict] = {'hall': {}, 'empty': {}}
    for name, (scenario_file, codebook_file) in SYSTEMS.items():
        scenario = Scenario.from_yaml(ROOT / 'config' / scenario_file)
        codebook = Codebook.load(ROOT / 'config' / codebook_file)
        rng = np.random.default_rng(options.seed)
        empty, hall, known = (
            dataclasses.replace(scenario, channel=options.folder / f'{file}.npz')
            for file in ('empty_test', 'hall_test', 'hall_survey'))
        figures['empty'][name] = report('empty', name, 'none', [
            measure(scenario, codebook, *receive(empty, codebook, rng))])
        figures['hall'][name] = {'shipped': report('hall', name, 'none', [
            measure(scenario, codebook, *receive(hall, codebook, rng))])}
        for n in options.positions:
            results = []
            for _ in range(options.surveys):
                with warnings.catch_warnings():
                    warnings.simplefilter('ignore', SurveyWarning)
                    multipath = survey(scenario, codebook, *receive(known, codebook, rng, n))
                measured = dataclasses.replace(scenario, multipath=multipath)
                results.append(measure(measured, codebook, *receive(hall, codebook, rng)))
            figures['hall'][name][str(n)] = report('hall', name, f'{n} positions', results)
    if options.json:
        write_whole(options.json, json.dumps(figures, indent=2) + '\n')


def receive(traced: Scenario, codebook: Codebook, rng: np.random.Generator, n: int | None = None
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return the users of a channel, or n random ones of them, and their signals."""
    assert traced.channel
    users = traced.channel.users
    if n is not None:
        users = rng.permutation(users)[:n]
    return users, simulate_received(traced, codebook, users, rng)


def measure(scenario: Scenario, codebook: Codebook, positions: np.ndarray, received: np.ndarray
            ) -> Result:
    """Locate users with the estimator that also considers positions outside of the region."""
    estimate = make_estimator('bayes', scenario, codebook, reject_outside=True).estimate(received)
    fix = estimate.fix
    errors = (estimate.mean - positions)[fix]
    distances = np.einsum(
        'na,na->n', errors, np.linalg.solve(estimate.covariance[fix], errors[..., None])[..., 0])
    rms_m = float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if fix.any() else np.nan
    return Result(len(fix), int(fix.sum()), int(np.sum(distances <= REGION_RADIUS)), rms_m)


def report(hall: str, system: str, known: str, results: list[Result]) -> dict[str, float | list]:
    """Print a row, and return its figures: means, and the worst share in the region."""
    shares = [result.shares for result in results]
    covered = [one['in_region'] for one in shares]
    # A mean of several surveys has the interval of one, because they share the users.
    fix, inside = (np.mean([
        share_percent(getattr(result, key), total) for result, total in zip(
            results, totals, strict=True)], axis=0) for key, totals in (
                ('fixes', [result.n for result in results]),
                ('inside', [max(result.fixes, 1) for result in results])))
    rms_m = float(np.mean([one['rms_m'] for one in shares]))
    print(f'| {hall} | {system} | {known} | {fix[0]:.1f} [{fix[1]:.1f}, {fix[2]:.1f}] | '
          f'{inside[0]:.1f} [{inside[1]:.1f}, {inside[2]:.1f}] | {100 * min(covered):.1f} to '
          f'{100 * max(covered):.1f} | {rms_m:.3f} |', flush=True)
    return {'fix': float(np.mean([one['fix'] for one in shares])), 'in_region': min(covered),
            'rms_m': rms_m, 'each': shares}


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError, ScenarioError)))
