"""Measure CPU times with the package in PYTHONPATH, which may be of another revision.

Usage: speed_worker.py CONFIG SIGNALS. CONFIG is the folder ``config`` of the revision, and SIGNALS
a folder with the signals of each case. Each line on the standard input is a case, ``single``,
``batch`` or ``build``, and the first and last index of its signals; each line on the standard
output is a list of times [s]. With ``stages`` in place of the folders, the arguments are fields in
which a scenario differs from Table I, and a number of fixes; see `stages`.
"""

import dataclasses
import functools
import json
import math
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats.qmc  # noqa: F401 - estimators import it when they first need it

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.unoptimised import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.positioning import Site, SiteEstimator, Tracker, fuse, make_estimator

# Fields in which each case differs from Table I.
FIXES: dict[str, dict[str, Any]] = {
    'plain': {}, 'gain': {'user_gain_std_db': 1.0},
    'band_phases': {'band_phase_std_rad': 2 * math.pi},
    'timing': {'timing_std_s': 20e-9}, 'element_errors': {'element_error_rms': 0.05},
    'failures': {'failed_element_share': 0.01}}
BUILDS: dict[str, dict[str, Any]] = {
    'table1': {}, 'elements': {'elements_per_side': 32}, 'subbands': {'n_subbands': 128}}
LAB, FUSION, TRACK = 'lab', 'fusion', 'track'
BATCH = 50
# Cycles of each track, their period [s], and the step between them [m].
CYCLES, PERIOD_S, STEP_M = 20, 0.1, 0.1


def system(config: Path, case: str) -> tuple[Scenario, Codebook, dict[str, Any]]:
    """Return scenario, codebook and knowledge of the surface of a case."""
    if case == LAB:
        scenario = Scenario.from_yaml(config / 'lab.yaml')
        return scenario, Codebook.load(config / 'codebook_lab.yaml'), {
            'surface': load_surface(str(config / 'lab_states.npz'), scenario)}
    scenario = dataclasses.replace(Scenario(), **FIXES.get(case, BUILDS.get(case, {})))
    if case in BUILDS:
        return scenario, random_codebook(scenario, np.random.default_rng(1)), {}
    return scenario, Codebook.load(config / 'codebook.yaml'), {}


def signals(config: Path, case: str, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Simulate the signals of a case at n positions, for each surface.

    Elements fail and deviate anew for each position, except in a site.
    """
    if case == FUSION:
        site = Site.from_yaml(config / 'site.yaml')
        low, high = site.bounds_m
        return site.sample(low + (high - low) * rng.random((n, 3)), rng)
    scenario, codebook, known = system(config, case)
    positions = scenario.sample_positions(n, rng)
    if case == TRACK:
        walk, cycle = np.divmod(np.arange(n), CYCLES)
        positions = positions[walk]
        positions[:, 1] += STEP_M * cycle
        positions = np.clip(positions, *scenario.roi_bounds_m)
    model = MeasurementModel(scenario, codebook, **known)
    return {case: np.concatenate([model.sample(one[None], rng) for one in positions])}


def function(config: Path, case: str, received: dict[str, np.ndarray]) -> Callable[[Any], Any]:
    """Return the function to measure, of the index of a signal or of several."""
    if case == FUSION:
        site = Site.from_yaml(config / 'site.yaml')
        estimator, bounds = SiteEstimator(site), site.bounds_m
        n_shots = len(next(iter(received.values())))
        shots = [{name: one[n] for name, one in received.items()} for n in range(n_shots)]
        seen = [list(estimator.sightings(one).values()) for one in shots]
        for one in seen:
            # Sightings are computed when they are first read.
            fuse(one, bounds)
        return lambda n: fuse(seen[n], bounds)
    locate = build(system(config, case))
    (of_user,) = received.values()
    locate.estimate(of_user[:2])
    if case != TRACK:
        return lambda n: locate.estimate(of_user[n])
    trackers: dict[int, Tracker] = {}

    def follow(n: int) -> Any:
        walk, cycle = divmod(n, CYCLES)
        tracker = trackers.setdefault(walk, Tracker(locate))
        return tracker.update(PERIOD_S * cycle, of_user[n])

    return follow


def build(parts: tuple[Scenario, Codebook, dict[str, Any]], _: int = 0) -> Any:
    """Build the estimator of a case."""
    scenario, codebook, known = parts
    return make_estimator('bayes', scenario, codebook, reject_outside=True, **known)


def stages(fields: dict[str, Any], n: int) -> dict[str, float]:
    """Return CPU times [s] of all that leads to n fixes, of a fix, and the peak memory [GiB]."""
    begin, found = time.process_time(), {}
    scenario = dataclasses.replace(Scenario(), **fields)
    codebook = random_codebook(scenario, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    positions = scenario.sample_positions(n, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    found['simulate_s'] = time.process_time() - begin
    crlb(scenario, codebook, positions)
    found['crlb_s'] = time.process_time() - begin - found['simulate_s']
    before = time.process_time()
    locate = build((scenario, codebook, {}))
    found['build_s'] = time.process_time() - before
    locate.estimate(received[0])
    before = time.process_time()
    for one in received:
        locate.estimate(one)
    found['fix_s'] = (time.process_time() - before) / n
    found['total_s'] = time.process_time() - begin
    return found | {'memory_gib': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}


def main() -> None:
    """Measure what the standard input names."""
    if sys.argv[1] == 'stages':
        print(json.dumps(stages(json.loads(sys.argv[2]), int(sys.argv[3]))))
        return
    config, folder = map(Path, sys.argv[1:])
    known: dict[str, Callable[[Any], Any]] = {}
    for line in sys.stdin:
        case, kind, first, last = line.split()
        if kind == 'build':
            call: Callable[[Any], Any]
            items: list[Any]
            call, items = functools.partial(build, system(config, case)), [0]
        else:
            if case not in known:
                with np.load(folder / f'{case}.npz') as stored:
                    known[case] = function(config, case, dict(stored))
            call, items = known[case], list(range(int(first), int(last)))
            if kind == 'batch':
                items = [slice(n, n + BATCH) for n in items[::BATCH]]
        times = []
        for item in items:
            begin = time.process_time()
            call(item)
            times.append(time.process_time() - begin)
        print(json.dumps(times), flush=True)


if __name__ == '__main__':
    main()
