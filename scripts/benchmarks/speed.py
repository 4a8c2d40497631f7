"""CPU times of estimators, relative to another revision of the package.

Problem: is a change faster, on a machine whose speed varies? The other revision is unpacked in a
scratch folder. Both process the same signals in turn, with one thread each. Times are CPU times of
single estimates, of estimates in batches of 50, and of building an estimator without stored
tables; only the ratios can be compared between machines. The first cycle of a track, which has no
prior, counts too.

With `--growth`, how do times and memory grow with the numbers of sub-bands, frames, elements and
feeds, and with the region? A signal of New Radio with 3276 sub-carriers comes last.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from parts import frame, speed_worker

ROOT = Path(__file__).parents[2]
CASES = (*speed_worker.FIXES, speed_worker.LAB, speed_worker.FUSION, speed_worker.TRACK)
BUILD = 'build'
# Sizes that grow by factors of two, as fields in which scenarios differ from Table I. The region
# grows along x. Sub-bands are those of New Radio with a spacing of 30 kHz, and the last scenario
# has those of a carrier of 100 MHz.
GRID = {'center_frequencies_hz': [2.75e9], 'subband_width_hz': 30e3,
        'frame_duration_s': 1e-3 / 28}
GROWTH = {
    'sub-bands': [GRID | {'n_subbands': 8 * n} for n in (16, 32, 64, 128)],
    'frames': [{'n_frames': 4 * n} for n in (1, 2, 4, 8)],
    'elements': [{'elements_per_side': [10 * n, 10]} for n in (1, 2, 4, 8)],
    'feeds': [{'n_feeds': 3 * n} for n in (1, 2, 4)],
    'volume of the region': [
        {'roi_center_m': [5 + 5 * n, 0.0, 0.0], 'roi_size_m': [10.0 * n, 10.0, 2.0]}
        for n in (1, 2, 4)],
    '3276 sub-bands': [GRID | {'n_subbands': 3276}]}
# Estimates of one revision before the other takes its turn, and how often estimators are built.
TURN, BUILDS = 20, 3


class Worker:
    """A process that measures one revision."""

    def __init__(self, root: Path, folder: Path) -> None:
        environment = os.environ | {'PYTHONPATH': str(root), 'OPENBLAS_NUM_THREADS': '1'}
        self._process = subprocess.Popen(
            [sys.executable, speed_worker.__file__, root / 'config', folder], env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def times_s(self, case: str, kind: str, first: int = 0, last: int = 0) -> list[float]:
        """Measure a case."""
        assert self._process.stdin and self._process.stdout
        print(case, kind, first, last, file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        if not line:
            sys.exit(f'{case}: the process of one revision has ended')
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


@contextmanager
def workers(roots: list[Path], folder: Path) -> Iterator[list[Worker]]:
    """Start a process for each revision."""
    with ExitStack() as stack:
        both = [Worker(root, folder) for root in roots]
        for one in both:
            stack.callback(one.close)
        yield both


def compare(roots: list[Path], folder: Path, case: str, kind: str, n: int) -> np.ndarray:
    """Return the times of both revisions, float64 [2, T] [s]."""
    times_s: list[list[float]] = [[], []]
    if kind == BUILD:
        # Later builds of a process would use the cached covariances of the first one.
        for _ in range(BUILDS):
            with workers(roots, folder) as both:
                for one, found in zip(both, times_s, strict=True):
                    found += one.times_s(case, kind)
        return np.array(times_s)
    turn = speed_worker.BATCH if kind == 'batch' else TURN
    with workers(roots, folder) as both:
        for first in range(0, n, turn):
            for one, found in zip(both, times_s, strict=True):
                found += one.times_s(case, kind, first, min(first + turn, n))
    return np.array(times_s)


def measure(options: argparse.Namespace, roots: list[Path], folder: Path) -> dict[str, object]:
    """Measure all cases and print a row for each."""
    table = frame.Table(['case', 'kind'], {
        'other [ms]': ('other_ms', 2), 'own [ms]': ('own_ms', 2), 'ratio': ('ratio', 3)})
    results: dict[str, dict[str, object]] = {}
    cases = [(case, kind) for case in CASES for kind in (
        ('single',) if case in (speed_worker.FUSION, speed_worker.TRACK) else ('single', 'batch'))]
    cases += [(case, BUILD) for case in speed_worker.BUILDS]
    for case, kind in cases:
        if options.only and case not in options.only:
            continue
        if kind != BUILD and not (folder / f'{case}.npz').exists():
            np.savez(folder / f'{case}.npz', **speed_worker.signals(
                frame.CONFIG, case, options.positions, np.random.default_rng(options.seed)))
        other_s, own_s = compare(roots, folder, case, kind, options.positions)
        per = 1e3 / (speed_worker.BATCH if kind == 'batch' else 1)
        results.setdefault(case, {})[kind] = table.row(
            case, kind, other_ms=per * float(other_s.mean()), own_ms=per * float(own_s.mean()),
            ratio=frame.mean_interval(own_s, relative_to=other_s))
    return dict(results)


def growth(n: int) -> dict[str, object]:
    """Measure each size in a process of its own, and print a row for each."""
    table = frame.Table(['size', 'factor'], {
        'simulate [s]': ('simulate_s', 2), 'bounds [s]': ('crlb_s', 2),
        'build [s]': ('build_s', 2), 'fix [s]': ('fix_s', 4), 'total [s]': ('total_s', 1),
        'memory [GiB]': ('memory_gib', 2)})
    rows: dict[str, list[dict[str, object]]] = {}
    for size, sizes in GROWTH.items():
        for number, fields in enumerate(sizes):
            found = subprocess.run(
                [sys.executable, speed_worker.__file__, 'stages', json.dumps(fields), str(n)],
                env=os.environ | {'PYTHONPATH': str(ROOT), 'OPENBLAS_NUM_THREADS': '1'},
                stdout=subprocess.PIPE, check=True)
            rows.setdefault(size, []).append(
                table.row(size, str(2**number), **json.loads(found.stdout)))
    print()
    exponents = frame.Table(['size'], {'build': ('build', 2), 'fix': ('fix', 2)})
    found_of = {}
    for size, times in rows.items():
        if len(times) > 1:
            found_of[size] = exponents.row(size, **{
                kind: float(np.polyfit(np.arange(len(times)), np.log2(
                    [one[f'{kind}_s'] for one in times]), 1)[0]) for kind in ('build', 'fix')})
    return {'sizes': rows, 'exponents': found_of}


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('speed', __doc__, positions=200)
    parser.add_argument('--against', default='HEAD', metavar='REV',
                        help='revision to compare with (default: %(default)s)')
    parser.add_argument('--only', action='append', choices=[*CASES, *speed_worker.BUILDS],
                        help='measure only this case; repeatable')
    parser.add_argument('--growth', action='store_true',
                        help='measure the growth with the sizes of a scenario instead')
    options = parser.parse_args()
    if options.growth:
        frame.write_results(options.json, growth(options.positions))
        return
    with tempfile.TemporaryDirectory() as scratch:
        other, folder = Path(scratch, 'other'), Path(scratch, 'signals')
        other.mkdir()
        folder.mkdir()
        packed = subprocess.run(
            ['git', '-C', ROOT, 'archive', options.against, 'rhs_isac_ros', 'config'],
            stdout=subprocess.PIPE, check=False)
        if packed.returncode:
            parser.error(f'argument --against: {options.against!r}, expected a revision of {ROOT}')
        subprocess.run(['tar', '-x', '-C', other], input=packed.stdout, check=True)
        frame.write_results(options.json, measure(options, [other, ROOT], folder))


if __name__ == '__main__':
    frame.run(main)
