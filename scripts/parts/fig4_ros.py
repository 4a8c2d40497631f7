"""Fig. 4 (b) in a running network of ROS nodes.

Problem: does the network add anything to the error that the library computes? The network serves
users at random positions. Each published estimate must equal, up to rounding, that of the library
for the published signals. The capacity losses must agree with those that the library finds for
the same positions, with multipath and noise drawn independently; the two samples are compared
position by position.
"""

import tempfile
from pathlib import Path

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from tqdm import tqdm

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments import JobError, markdown_table
from rhs_isac_ros.link import capacity_report, choose_beam
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.ros.environment import private_domain
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.tools.demo import watch

# Users of a network, each at its own position, and cycles for each.
USERS, CYCLES_PER_USER = 25, 4
# Cycles in all, without and with --quick.
CYCLES, QUICK_CYCLES = 500, 100
# Estimates are equal if they differ by less [m].
TOLERANCE_M = 1e-9
SEED, RESAMPLES = 1 << 21, 2000


def compare(codebook_file: Path, cycles: int, output: Path) -> None:
    """Run networks, compare them with the library, and print and write the report."""
    scenario, codebook = Scenario(), Codebook.load(codebook_file)
    records = run_networks(codebook_file, cycles)
    truth = np.array([record.truth.position for record in records])
    estimator = make_estimator('bayes', scenario, codebook)
    received = np.stack([record.signals.stacked for record in records])
    # One by one, as in the network: estimates of several phases in one call round differently.
    repeated = np.array([estimator.estimate(signals).mean for signals in received])
    published = np.array([record.estimate.position for record in records])
    difference_m = np.abs(published - repeated).max()

    signals = simulate_received(scenario, codebook, truth, np.random.default_rng(SEED))
    simulated = estimator.estimate(signals)
    losses = np.array([
        capacity_report(
            scenario, choose_beam(scenario, mean, covariance).beam, position).loss_bps
        for position, mean, covariance in zip(
            truth, simulated.mean, simulated.covariance, strict=True)])
    samples = {
        'squared error [m²]': (np.sum((published - truth)**2, axis=1),
                               np.sum((simulated.mean - truth)**2, axis=1)),
        'capacity loss [bit/s]': (
            np.array([record.capacity.loss_bps for record in records]), losses)}
    report = '\n\n'.join([
        f'{len(records)} cycles of {len(np.unique(truth, axis=0))} users in the network.',
        f'Published estimates and those of the library for the same signals differ by at most '
        f'{difference_m:.1e} m: {"the same" if difference_m < TOLERANCE_M else "NOT the same"}.',
        comparison(samples, truth)])
    write_whole(output / 'fig4_ros.md', f'# Fig. 4 (b) over ROS\n\n{report}\n')
    print(f'{report}\n\nwritten: {output}/fig4_ros.md')


def comparison(samples: dict[str, tuple[np.ndarray, np.ndarray]], truth: np.ndarray) -> str:
    """Return a table of means and medians, with 95 % intervals of their differences."""
    _, site = np.unique(truth, axis=0, return_inverse=True)
    site = site.ravel()
    members = [np.nonzero(site == index)[0] for index in range(site.max() + 1)]
    rng = np.random.default_rng(SEED)
    # Cycles at one position are not independent samples of the region: resample positions.
    picks = rng.integers(len(members), size=(RESAMPLES, len(members)))
    draws = [np.concatenate([members[index] for index in pick]) for pick in picks]
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
        ['quantity', 'network', 'library', '95 % interval of the difference', 'agree'], rows)


def run_networks(codebook_file: Path, cycles: int) -> list[CompleteCycle]:
    """Return the records of cycles, from as many networks in succession as needed."""
    records: list[CompleteCycle] = []
    domain = private_domain()
    rclpy.init(domain_id=int(domain['ROS_DOMAIN_ID']),
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        with tqdm(total=cycles, unit='cycle', disable=None) as bar:
            seed = 0
            while len(records) < cycles:
                batch = min(USERS * CYCLES_PER_USER, cycles - len(records))
                records += run_network(codebook_file, batch, seed, domain, bar)
                seed += 1
    finally:
        rclpy.try_shutdown()
    return records


def run_network(codebook_file: Path, cycles: int, seed: int, domain: dict[str, str],
                bar: tqdm) -> list[CompleteCycle]:
    """Return the records of cycles of one network; the seed determines its users' positions."""
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
