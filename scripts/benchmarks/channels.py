"""Positioning on channels that a ray tracer computed, before and after a survey of the hall.

Problem: the estimator assumes Gaussian multipath, as three fields of the scenario declare it, but
in a hall, walls cause the multipath. How much does a survey at known positions help? Signals
follow the traced paths of users in an empty hall and in one with reflections. From 10 to 300 other
users of the same hall, `calibration.survey` estimates the covariance of the multipath. Surveys are
drawn several times, each time with other thermal noise in all signals. The 95 % region of an
estimate is the ellipsoid of its covariance that contains 95 % of a Gaussian; an estimate whose
region does not contain the user is confidently wrong. Shares have Wilson's 95 % intervals over the
users. For several surveys, the table lists means, and the range of the share in the region.

With --blocked, a share of the users of the hall and of its surveys lacks the direct path. The
estimator always assumes that this is the case for 10 % of the users.

The folder contains empty_test.npz, hall_test.npz and hall_survey.npz with propagation paths.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import dataclasses
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from parts.command import benchmark_parser, write_results
from scipy.stats import chi2

from rhs_isac_ros.calibration import SurveyWarning, survey
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import Scenario, ScenarioError, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.arguments import (
    positive_int,
    share,
)

ROOT = Path(__file__).parents[2]
SYSTEMS = {'table1': ('table1.yaml', 'codebook.yaml'),
           'bandplan': ('bandplan.yaml', 'codebook_bandplan.yaml')}
REGION_RADIUS = float(chi2.ppf(0.95, 3))
# Assumed share of blocked users.
PRIOR = 0.1


class Result(NamedTuple):
    """Numbers of users, of fixes and of those in the 95 % region, and the error of the fixes."""

    n: int
    fixes: int
    inside: int
    rms_m: float

    @property
    def shares(self) -> dict[str, float]:
        """Shares of users with a fix, of fixes in the region, of users with one outside; error."""
        return {'fix': self.fixes / self.n, 'in_region': self.inside / max(self.fixes, 1),
                'wrong': (self.fixes - self.inside) / self.n, 'rms_m': self.rms_m}


class Received(NamedTuple):
    """Users, [N, 3], their signals, [N, N_B, N_SB F], and whether they are blocked, bool [N]."""

    users: np.ndarray
    signals: np.ndarray
    blocked: np.ndarray


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('channels', __doc__)
    add = parser.add_argument
    add('folder', type=Path, nargs='?', default=ROOT.parent / 'shared' / 'channels',
        help='folder of the channel files (default: ../shared/channels of the repository)')
    add('--surveys', type=positive_int, default=5,
        help='random surveys of each size (default: %(default)s)')
    add('--positions', type=positive_int, nargs='+', default=[10, 30, 100, 300],
        help='sizes of the surveys (default: 10 30 100 300)')
    add('--blocked', type=share, nargs='+', default=[], metavar='SHARE',
        help='also measure with this share of users without direct path, from 0 to 1')
    options = parser.parse_args()
    print('| hall | system | survey | fix [%] | in the 95 % region [%] | range over surveys [%] | '
          'confidently wrong [%] | rms error [m] |\n|---|---|---|---|---|---|---|---|')
    figures: dict[str, dict] = {'hall': {}, 'empty': {}}
    for name, (scenario_file, codebook_file) in SYSTEMS.items():
        scenario = Scenario.from_yaml(ROOT / 'config' / scenario_file)
        codebook = Codebook.load(ROOT / 'config' / codebook_file)
        rng = np.random.default_rng(options.seed)
        empty, hall, known = (
            dataclasses.replace(scenario, channel=options.folder / f'{file}.npz')
            for file in ('empty_test', 'hall_test', 'hall_survey'))
        figures['empty'][name] = report('empty', name, 'none', [
            measure(scenario, codebook, receive(empty, codebook, rng))])['']
        figures['hall'][name] = {'shipped': report('hall', name, 'none', [
            measure(scenario, codebook, receive(hall, codebook, rng))])['']}
        for hidden in (0.0, *options.blocked):
            place = f'hall, {100 * hidden:g} % blocked' if hidden else 'hall'
            for n in options.positions:
                results = []
                for _ in range(options.surveys):
                    surveyed = receive(known, codebook, rng, n, hidden)
                    with warnings.catch_warnings():
                        warnings.simplefilter('ignore', SurveyWarning)
                        multipath = survey(
                            scenario, codebook, surveyed.users, surveyed.signals)
                    measured = dataclasses.replace(
                        scenario, multipath=multipath,
                        blocked_probability=PRIOR if hidden else 0.0)
                    results.append(measure(
                        measured, codebook, receive(hall, codebook, rng, hidden=hidden)))
                for users, found in report(place, name, f'{n} positions', results).items():
                    key = f'{users}, {hidden:g} blocked' if users else 'hall'
                    figures.setdefault(key, {}).setdefault(name, {})[str(n)] = found
    write_results(options.json, figures)


def receive(traced: Scenario, codebook: Codebook, rng: np.random.Generator,
            n: int | None = None, hidden: float = 0.0) -> Received:
    """Return the users of a channel, or n random ones, of whom a share has no direct path."""
    assert traced.channel
    users = traced.channel.users
    if n is not None:
        users = rng.permutation(users)[:n]
    # A generator of its own leaves the other figures as they are without blocked users.
    blocked = rng.spawn(1)[0].permutation(len(users)) < round(hidden * len(users))
    signals = np.empty((len(users), *codebook_shape(codebook)), complex)
    for state in (False, True):
        if (chosen := blocked == state).any():
            signals[chosen] = simulate_received(
                dataclasses.replace(traced, blocked_probability=float(state)), codebook,
                users[chosen], rng)
    return Received(users, signals, blocked)


def codebook_shape(codebook: Codebook) -> tuple[int, int]:
    """Return the numbers N_B of bands and N_SB F of measurements of each band."""
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    return n_bands, n_subbands * n_frames


def measure(scenario: Scenario, codebook: Codebook, received: Received) -> dict[str, Result]:
    """Locate users with the estimator that also considers positions outside of the region.

    The results are those of all users, or if some are blocked, of those in sight and the others.
    """
    users, signals, blocked = received
    estimate = make_estimator('bayes', scenario, codebook, reject_outside=True).estimate(signals)
    fix = estimate.fix
    errors = np.where(fix[:, None], estimate.mean - users, 0.0)
    covariance = np.where(fix[:, None, None], estimate.covariance, np.eye(3))
    inside = fix & (np.einsum('na,na->n', errors, np.linalg.solve(
        covariance, errors[..., None])[..., 0]) <= REGION_RADIUS)
    squares = np.sum(errors**2, axis=1)
    groups = {'in sight': ~blocked, 'blocked': blocked} if blocked.any() else {'': ~blocked}
    return {name: Result(
        int(chosen.sum()), int(fix[chosen].sum()), int(inside[chosen].sum()),
        float(np.sqrt(squares[chosen & fix].mean())) if fix[chosen].any() else np.nan)
        for name, chosen in groups.items() if chosen.any()}


def report(hall: str, system: str, known: str, results: list[dict[str, Result]]
           ) -> dict[str, dict[str, float | list]]:
    """Print a row for each group of users, and return its figures.

    They are means, and the worst share in the region.
    """
    figures: dict[str, dict[str, float | list]] = {}
    for users in results[0]:
        found = [result[users] for result in results]
        shares = [result.shares for result in found]
        covered = [one['in_region'] for one in shares]
        # A mean of several surveys has the interval of one, because they share the users.
        fix, inside, wrong = (
            '{:.1f} [{:.1f}, {:.1f}]'.format(*np.mean(
                [share_percent(*pair) for pair in pairs], axis=0)) for pairs in (
                    [(one.fixes, one.n) for one in found],
                    [(one.inside, max(one.fixes, 1)) for one in found],
                    [(one.fixes - one.inside, one.n) for one in found]))
        rms_m = float(np.mean([one['rms_m'] for one in shares]))
        place = f'{hall}: {users}' if users else hall
        print(f'| {place} | {system} | {known} | {fix} | {inside} | {100 * min(covered):.1f} to '
              f'{100 * max(covered):.1f} | {wrong} | '
              f'{"" if np.isnan(rms_m) else f"{rms_m:.3f}"} |', flush=True)
        figures[users] = {
            'fix': float(np.mean([one['fix'] for one in shares])), 'in_region': min(covered),
            'wrong': max(one['wrong'] for one in shares), 'rms_m': rms_m, 'each': shares}
    return figures


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError, ScenarioError)))
