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

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from parts import frame

from rhs_isac_ros.calibration import SurveyWarning, survey
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.arguments import positive_int, share

# Assumed share of blocked users.
PRIOR = 0.1


class Received(NamedTuple):
    """Users, [N, 3], their signals, [N, N_B, N_SB F], and whether they are blocked, bool [N]."""

    users: np.ndarray
    signals: np.ndarray
    blocked: np.ndarray


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('channels', __doc__, has_jobs=True)
    add = parser.add_argument
    add('folder', type=Path, nargs='?', default=frame.CONFIG.parents[1] / 'shared' / 'channels',
        help='folder of the channel files')
    add('--surveys', type=positive_int, default=5,
        help='random surveys of each size')
    add('--positions', type=positive_int, nargs='+', default=[10, 30, 100, 300],
        help='sizes of the surveys')
    add('--blocked', type=share, nargs='+', default=[], metavar='SHARE',
        help='also measure with this share of users without direct path, from 0 to 1')
    options = parser.parse_args()
    table = frame.Table(['hall', 'system', 'survey'], {
        'fix [%]': ('fix', 1), 'in the 95 % region [%]': ('in_region', 1),
        'range over surveys [%]': ('range', 1), 'confidently wrong [%]': ('wrong', 1),
        'rms error [m]': ('rms_m', 3)})
    jobs, rows = {}, []
    for name in frame.SYSTEMS:
        scenario, codebook = frame.system(name)
        rng = np.random.default_rng(options.seed)

        def add_job(name: str, file: str, survey: tuple[str, int, float] | None,
                    rng: np.random.Generator, hidden: float = 0.0) -> str:
            """Add a job that draws from here on, and draw its numbers; return its name."""
            key = f'{name} {len(jobs)}'
            jobs[key] = {'system': name, 'folder': str(options.folder), 'file': file,
                         'known': survey, 'hidden': hidden, 'random': state_of(rng)}
            draws(name, str(options.folder), file, survey, hidden, rng)
            return key

        rows += [('empty', name, 'none', [add_job(name, 'empty_test', None, rng)]),
                 ('hall', name, 'none', [add_job(name, 'hall_test', None, rng)])]
        rows += [(f'hall, {100 * hidden:g} % blocked' if hidden else 'hall', name, n,
                  [add_job(name, 'hall_test', ('hall_survey', n, hidden), rng, hidden)
                   for _ in range(options.surveys)])
                 for hidden in (0.0, *options.blocked) for n in options.positions]
    found = frame.measured(options, 'channels', located, jobs)
    figures: dict[str, dict] = {'hall': {}, 'empty': {}}
    for place, name, n, keys in rows:
        results = [{users: frame.Fixes(*map(np.array, fixes))
                    for users, fixes in found[key].items()} for key in keys]
        known, hidden = n if n == 'none' else f'{n} positions', jobs[keys[0]]['hidden']
        for users, figure in report(table, place, name, known, results).items():
            key = f'{users}, {hidden:g} blocked' if users else place
            if place == 'empty':
                figures['empty'][name] = figure
            else:
                figures.setdefault(key, {}).setdefault(name, {})[
                    'shipped' if n == 'none' else str(n)] = figure
    frame.write_results(options.json, figures)


def state_of(rng: np.random.Generator) -> dict:
    """Return the state of a generator as numbers, including that of its next children."""
    seeds = rng.bit_generator.seed_seq
    return {'seed': seeds.entropy, 'children': seeds.n_children_spawned,
            'state': rng.bit_generator.state}


def generator_of(state: dict) -> np.random.Generator:
    """Return a generator with a state."""
    bits = np.random.PCG64(np.random.SeedSequence(
        state['seed'], n_children_spawned=state['children']))
    bits.state = state['state']
    return np.random.Generator(bits)


def draws(system: str, folder: str, file: str, known: Sequence | None, hidden: float,
          rng: np.random.Generator) -> tuple[Received | None, Received]:
    """Return the users of a survey, if any, and those to locate."""
    scenario, codebook = frame.system(system)

    def traced(name: str) -> Scenario:
        return dataclasses.replace(scenario, channel=Path(folder) / f'{name}.npz')
    surveyed = receive(traced(known[0]), codebook, rng, *known[1:]) if known else None
    return surveyed, receive(traced(file), codebook, rng, hidden=hidden)


def located(system: str, folder: str, file: str, known: Sequence | None, hidden: float,
            random: dict) -> dict[str, list]:
    """Run a job: locate the users of a channel, perhaps after a survey."""
    scenario, codebook = frame.system(system)
    surveyed, received = draws(system, folder, file, known, hidden, generator_of(random))
    if surveyed:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', SurveyWarning)
            multipath = survey(scenario, codebook, surveyed.users, surveyed.signals)
        scenario = dataclasses.replace(scenario, multipath=multipath,
                                       blocked_probability=PRIOR if hidden else 0.0)
    return {users: [*fixes] for users, fixes in measure(scenario, codebook, received).items()}


def receive(traced: Scenario, codebook: Codebook, rng: np.random.Generator,
            n: int | None = None, hidden: float = 0.0) -> Received:
    """Return the users of a channel, or n random ones, of whom a share has no direct path."""
    assert traced.channel
    users = traced.channel.users
    if n is not None:
        users = rng.permutation(users)[:n]
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    # A generator of its own leaves the other figures as they are without blocked users.
    blocked = rng.spawn(1)[0].permutation(len(users)) < round(hidden * len(users))
    signals = np.empty((len(users), n_bands, n_subbands * n_frames), complex)
    for state in (False, True):
        if (chosen := blocked == state).any():
            signals[chosen] = simulate_received(
                dataclasses.replace(traced, blocked_probability=float(state)), codebook,
                users[chosen], rng)
    return Received(users, signals, blocked)


def measure(scenario: Scenario, codebook: Codebook, received: Received) -> dict[str, frame.Fixes]:
    """Locate users with the estimator that also considers positions outside of the region.

    The results are those of all users, or if some are blocked, of those in sight and the others.
    """
    users, signals, blocked = received
    estimate = make_estimator('bayes', scenario, codebook, reject_outside=True).estimate(signals)
    groups = {'in sight': ~blocked, 'blocked': blocked} if blocked.any() else {'': ~blocked}
    return {name: frame.Fixes.of(dataclasses.replace(
        estimate, mean=estimate.mean[chosen], covariance=estimate.covariance[chosen]),
        users[chosen]) for name, chosen in groups.items() if chosen.any()}


def report(table: frame.Table, hall: str, system: str, known: str,
           results: list[dict[str, frame.Fixes]]) -> dict[str, dict]:
    """Print a row for each group of users, and return its figures: means over the surveys."""
    figures = {}
    for users in results[0]:
        found = [result[users] for result in results]
        counts = np.array([(len(one.fix), len(one.squared), one.inside.sum()) for one in found])
        n, n_fixes, inside = counts.T
        covered = 100 * inside / np.maximum(n_fixes, 1)
        errors_m = [one.squared.mean()**0.5 for one in found if len(one.squared)]
        figures[users] = table.row(
            f'{hall}: {users}' if users else hall, system, known, fix=mean_share(n_fixes, n),
            in_region=mean_share(inside, np.maximum(n_fixes, 1)),
            range=f'{covered.min():.1f} to {covered.max():.1f}',
            wrong=mean_share(n_fixes - inside, n),
            rms_m=np.mean(errors_m) if len(errors_m) == len(found) else None)
    return figures


def mean_share(counts: np.ndarray, totals: np.ndarray) -> list[float]:
    """Return a mean share over surveys, with the interval of one, because they share the users."""
    shares = [share_percent(int(n), int(total)) for n, total in zip(counts, totals, strict=True)]
    return np.mean(shares, axis=0).tolist()


if __name__ == '__main__':
    frame.run(main)
