"""Fig. 4 (b) once more, through a running network of ROS nodes.

Problem: does the network add anything to the error that the library computes? Users stand at
random positions; the network serves them. Each estimate of the positioner must be the library's
answer to the signals on the topic, to rounding. And the capacity losses must be those that the
library finds for the same positions with multipath and noise of its own: the two samples are
compared position by position.
"""

import tempfile
from pathlib import Path

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from tqdm import tqdm

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments import JobError, markdown_table
from rhs_isac_ros.link import choose_beam, outcome
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.tools.demo import watch

# A network has so many users, each at a place of its own, and serves each so often.
USERS, CYCLES_A_USER = 25, 4
# Cycles by the network, without and with --quick.
CYCLES, QUICK_CYCLES = 500, 100
# Estimates that differ by less are the same [m].
SAME_M = 1e-9
SEED, RESAMPLES = 1 << 21, 2000


def compare(codebook_file: Path, cycles: int, output: Path) -> None:
    """Run networks until they have served enough cycles, compare, print and write.

    Parameters
    ----------
    codebook_file
        The codebook.
    cycles
        How many cycles.
    output
        Folder of the results.
    """
    scenario, codebook = Scenario(), Codebook.load(codebook_file)
    records = measured(codebook_file, cycles)
    truth = np.array([record.truth.position for record in records])
    estimator = make_estimator('bayes', scenario, codebook)
    received = np.stack([record.signals.signals for record in records])
    repeated = estimator.estimate(received.reshape(len(records), scenario.n_bands, -1)).mean
    published = np.array([record.estimate.position for record in records])
    difference_m = np.abs(published - repeated).max()

    signals = simulate_received(scenario, codebook, truth, np.random.default_rng(SEED))
    alone = estimator.estimate(signals)
    losses = np.array([
        outcome(scenario, choose_beam(scenario, mean, covariance).beam, place).loss_bps
        for place, mean, covariance in zip(truth, alone.mean, alone.covariance, strict=True)])
    samples = {
        'squared error [m²]': (np.sum((published - truth)**2, axis=1),
                               np.sum((alone.mean - truth)**2, axis=1)),
        'capacity loss [bit/s]': (
            np.array([record.capacity.loss_bps for record in records]), losses)}
    report = '\n\n'.join([
        f'{len(records)} cycles of {len(np.unique(truth, axis=0))} users through the network.',
        f'Estimates on the topic and by the library for the same signals differ by at most '
        f'{difference_m:.1e} m: {"the same" if difference_m < SAME_M else "NOT the same"}.',
        comparison(samples, truth)])
    write_whole(output / 'fig4_ros.md', f'# Fig. 4 (b) over ROS\n\n{report}\n')
    print(f'{report}\n\nwritten: {output}/fig4_ros.md')


def comparison(samples: dict[str, tuple[np.ndarray, np.ndarray]], truth: np.ndarray) -> str:
    """Mean and median of both samples, and whether they agree: 95 % intervals of differences."""
    _, place = np.unique(truth, axis=0, return_inverse=True)
    place = place.ravel()
    members = [np.nonzero(place == one)[0] for one in range(place.max() + 1)]
    rng = np.random.default_rng(SEED)
    # Cycles at one place are no independent samples of the region: places are drawn anew.
    picks = rng.integers(len(members), size=(RESAMPLES, len(members)))
    draws = [np.concatenate([members[one] for one in pick]) for pick in picks]
    rows = []
    for name, (network, library) in samples.items():
        for statistic in (np.mean, np.median):
            low, high = np.percentile(
                [statistic(network[draw]) - statistic(library[draw]) for draw in draws],
                (2.5, 97.5))
            rows.append([
                f'{statistic.__name__} {name}', f'{statistic(network):.3g}',
                f'{statistic(library):.3g}', f'[{low:.2g}, {high:.2g}]',
                'yes' if low <= 0 <= high else 'no'])
    return markdown_table(
        ['what', 'network', 'library', '95 % interval of the difference', 'agree'], rows)


def measured(codebook_file: Path, cycles: int) -> list[CompleteCycle]:
    """Cycles of as many networks as it takes, one after the other."""
    records: list[CompleteCycle] = []
    domain = private_domain()
    rclpy.init(domain_id=int(domain['ROS_DOMAIN_ID']),
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        with tqdm(total=cycles, unit='cycle', disable=None) as bar:
            seed = 0
            while len(records) < cycles:
                some = min(USERS * CYCLES_A_USER, cycles - len(records))
                records += one_network(codebook_file, some, seed, domain, bar)
                seed += 1
    finally:
        rclpy.try_shutdown()
    return records


def one_network(codebook_file: Path, cycles: int, seed: int, domain: dict[str, str],
                bar: tqdm) -> list[CompleteCycle]:
    """Cycles of one network, whose users are placed by a seed."""
    observer = CycleObserver()
    before = bar.n
    try:
        with (tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs,
              Processes(Path(logs), domain) as processes):
            processes.start('network', users=USERS, seed=seed, codebook_file=codebook_file,
                            rest_s=0.0)
            problem = watch(observer, processes, cycles,
                            lambda done, _: bar.update(before + min(done, cycles) - bar.n))
    finally:
        observer.destroy_node()
    if problem:
        raise JobError(problem)
    return observer.log.complete[:cycles]
