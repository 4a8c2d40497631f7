"""Fig. 3 of the paper: average bound and computing time of the optimisation methods.

Problem: a base station has N_B bands, centred at (2 + 0.5 i) GHz, and measures F frames in each,
with N_B F = 8 frames in total. Which method finds the codebook with the lowest average CRLB over
N_sam = 10 random positions? The paper's alternating algorithm, gradient descent on all variables
at once, a genetic algorithm and the package's L-BFGS are compared, from the same start and with
the same samples; each of the 30 trials draws new ones. The paper makes four claims about its
algorithm:

(1) It reaches a lower CRLB than both benchmarks at each N_B.
(2) It takes less time than both.
(3) Its CRLB falls with N_B.
(4) Its lead in CRLB grows with N_B. The paper does not specify whether the lead is absolute or
    relative to the benchmark, so both are reported.

Beyond the paper, each codebook is also evaluated on 500 held-out positions, the same for all: a
method may overfit ten samples.

Duration on two cores: two minutes with --quick, about 20 minutes without.
"""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros import __version__
from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.codebook.optimize import INTERRUPTED
from rhs_isac_ros.experiments import Job, markdown_table, run_command, run_jobs
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.pictures import PAGE_IN, look, new_panels, paper_style

BANDS = (1, 2, 4, 8)
TOTAL_FRAMES = 8
PROPOSED, RIVALS = 'alternating', ('direct', 'genetic')
METHODS = (PROPOSED, *RIVALS, 'lbfgs')
# Names in the picture.
NAMES = {'alternating': 'alternating (Algorithm 1)', 'direct': 'direct gradient descent',
         'genetic': 'genetic algorithm', 'lbfgs': 'L-BFGS'}
SAMPLES, HELD_OUT, HELD_OUT_SEED = 10, 500, 0
TRIALS, QUICK_TRIALS = 30, 3
# As many update steps as the paper's method and `direct` perform by default.
LBFGS_STEPS = 400


def trial(method: str, n_bands: int, seed: int, samples: int, held_out: int,
          max_steps: int | None) -> dict:
    """Run one method in one trial."""
    scenario = Scenario(center_frequencies_hz=[2e9 + 0.5e9 * i for i in range(1, n_bands + 1)],
                        n_frames=TOTAL_FRAMES // n_bands)
    settings = {'method': method, 'sampling': 'monte_carlo', 'n_positions': samples, 'seed': seed}
    # Exclude imports and cached tables from the time.
    optimize(scenario, **settings, max_evaluations=1)
    # The time of this thread, so that other load on the machine does not count.
    begin = time.thread_time()
    result = optimize(scenario, **settings, max_steps=max_steps)
    seconds = time.thread_time() - begin
    if result.reason == INTERRUPTED:  # the result is not that of the complete method
        raise KeyboardInterrupt
    held_out_positions = scenario.sample_positions(
        held_out, streams.generator(HELD_OUT_SEED, streams.HELD_OUT))
    bounds = crlb(scenario, result.codebook, held_out_positions)
    end = result.history[-1]
    return {'crlb_m2': end.value_m2, 'held_out_m2': float(np.mean(bounds)),
            'held_out_median_m2': float(np.median(bounds)), 'seconds': seconds,
            'evaluations': end.evaluations, 'steps': end.step, 'reason': result.reason,
            'codebook': result.codebook.id}


def make_jobs(trials: int) -> list[Job]:
    """List the jobs, with the methods of a trial adjacent so that they run under similar load."""
    return [Job(f'{method}-{n_bands}-bands-trial-{seed}',
                {'method': method, 'n_bands': n_bands, 'seed': seed, 'samples': SAMPLES,
                 'held_out': HELD_OUT,
                 'max_steps': LBFGS_STEPS if method == 'lbfgs' else None})
            for seed in range(trials) for n_bands in BANDS for method in METHODS]


class Summary:
    """Statistics of the trials by method and number of bands."""

    def __init__(self, trials: Sequence[dict]) -> None:
        self._trials = trials
        self.count = len({entry['seed'] for entry in trials})
        self._time_unit = np.mean(self.of('seconds', PROPOSED, BANDS[0]))

    def of(self, name: str, method: str, n_bands: int) -> np.ndarray:
        """Return the values of all trials, in order."""
        if name == 'normalised':
            return self.of('seconds', method, n_bands) / self._time_unit
        return np.array([entry[name] for entry in self._trials
                         if (entry['method'], entry['n_bands']) == (method, n_bands)])

    def table(self) -> str:
        """Return a table with a row for each method and number of bands."""
        rows = []
        for method in METHODS:
            for n in BANDS:
                entries = [plus_minus(*mean_and_std(self.of(name, method, n)))
                           for name in ('crlb_m2', 'held_out_m2', 'seconds', 'normalised')]
                median = np.median(self.of('held_out_m2', method, n))
                entries.insert(2, plus_minus(float(median), np.nan))
                rows.append([method, str(n), *entries])
        return markdown_table(
            ['method', 'N_B', 'CRLB on samples [m²]', 'CRLB held out [m²]', 'its median [m²]',
             'time [s]', 'normalised time'], rows)

    def claims(self) -> list[str]:
        """Return for each claim of the paper whether it holds here, with the numbers."""
        means = [self.of('crlb_m2', PROPOSED, n).mean() for n in BANDS]
        chain = ', '.join(f'{value:.4f}' for value in means)
        bands = ', '.join(map(str, BANDS))
        absolute = {rival: [self.of('crlb_m2', rival, n).mean() - own
                            for n, own in zip(BANDS, means, strict=True)] for rival in RIVALS}
        relative = {rival: [100 * lead / (lead + own) for lead, own in zip(
            leads, means, strict=True)] for rival, leads in absolute.items()}
        return [
            self._less('crlb_m2', 'm²', f'(1) {PROPOSED} reaches a lower CRLB than its rivals'),
            self._less('seconds', 's', f'(2) {PROPOSED} takes less time than its rivals'),
            f'(3) The CRLB of {PROPOSED} falls with N_B: '
            f'{_verdict(bool(np.all(np.diff(means) < 0)))}. It is {chain} m² with N_B = {bands}.',
            f'(4) The lead of {PROPOSED} grows with N_B = {bands}. The absolute lead: '
            f'{_growth(absolute, "m²", 4)}. The lead relative to the rival: '
            f'{_growth(relative, "%", 0)}.']

    def _less(self, name: str, unit: str, claim: str) -> str:
        holds, details = True, []
        for n in BANDS:
            own, rivals = self.of(name, PROPOSED, n), []
            for rival in RIVALS:
                other = self.of(name, rival, n)
                holds &= bool(own.mean() < other.mean())
                rivals.append(f'{other.mean():.4f} {unit} of {rival} ({PROPOSED} is lower in '
                               f'{np.sum(own < other)} of {self.count} trials)')
            details.append(f'With N_B = {n}: {own.mean():.4f} {unit} against '
                             f'{" and ".join(rivals)}.')
        return f'{claim} at each N_B: {_verdict(holds)}. {" ".join(details)}'


def _growth(leads: Mapping[str, Sequence[float]], unit: str, digits: int) -> str:
    """Return for each rival whether the lead over it grows, with the numbers."""
    return '; '.join(
        f'{_verdict(bool(np.all(np.diff(values) > 0)))} over {rival}, '
        f'{", ".join(f"{value:.{digits}f}" for value in values)} {unit}'
        for rival, values in leads.items())


def _verdict(holds: bool) -> str:
    return 'holds' if holds else 'does not hold'


@paper_style('drawing the figure')
def picture(summary: Summary) -> Any:
    """Draw both panels; error bars are standard deviations, as in the paper."""
    figure, ((left, right),), above = new_panels(PAGE_IN, 2.9, 1, 2)
    positions = np.arange(len(BANDS))
    for axes, name in ((left, 'crlb_m2'), (right, 'normalised')):
        # Shifted so that the bars do not overlap.
        for index, (method, shift) in enumerate(
                zip(METHODS, np.linspace(-0.15, 0.15, len(METHODS)), strict=True)):
            means, stds = np.array(
                [mean_and_std(summary.of(name, method, n)) for n in BANDS]).T
            own = look(index)
            # A single trial has no deviation.
            axes.errorbar(positions + shift, means, np.nan_to_num(stds), color=own.colour,
                          marker=own.marker, linestyle=own.line, label=NAMES[method])
        axes.set_xlabel(r'number of bands $N_\mathrm{B}$, with '
                        rf'$N_\mathrm{{B}} F = {TOTAL_FRAMES}$ frames')
        axes.set_xticks(positions, BANDS)
        axes.grid(axis='y')
    left.set(ylabel=rf'average CRLB of $N_\mathrm{{sam}} = {SAMPLES}$ samples [m$^2$]',
             ylim=(0, None), title='(a)')
    right.set(ylabel=f'CPU time, relative to {PROPOSED}\n'
                     rf'with $N_\mathrm{{B}} = {BANDS[0]}$', ylim=(0, None), title='(b)')
    handles, labels = left.get_legend_handles_labels()
    above.legend(handles, labels, loc='lower center', ncols=len(METHODS),
                 title=f'mean and standard deviation of {summary.count} trials')
    return figure


def reproduce(options: argparse.Namespace) -> None:
    """Run the jobs that have no results yet, print the report and write the files."""
    trials, jobs = options.trials, make_jobs(options.trials)
    results = run_jobs(frame.imported(trial), jobs, options.output / 'jobs', options.jobs,
                       options.dask)
    entries = [{**job.arguments, **result} for job, result in zip(jobs, results, strict=True)]
    summary = Summary(entries)
    report = '\n\n'.join([
        f'Mean ± standard deviation of {trials} trials with {SAMPLES} samples each; {HELD_OUT} '
        f'held-out positions. Time is CPU time on one core, normalised to {PROPOSED} with '
        f'N_B = {BANDS[0]}.',
        summary.table(), *summary.claims()])
    data = json.dumps({'version': __version__, 'trials': entries}, indent=1) + '\n'
    frame.write_report(
        options, 'fig3', 'Fig. 3', report, picture(summary), {'fig3.json': data})


def mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of a sample.

    The mean is infinite if a value is. The deviation is NaN if it is undefined: for a single
    value, or an infinite mean.
    """
    mean = float(np.mean(values))
    if len(values) < 2 or not np.isfinite(mean):
        return mean, float('nan')
    return mean, float(np.std(values, ddof=1))


def plus_minus(mean: float, std: float, digits: int = 3) -> str:
    """Format a mean, to some significant digits, and its deviation to the same decimal place.

    A deviation of NaN is omitted.
    """
    if not np.isfinite(mean):
        return str(mean)
    magnitude = int(np.floor(np.log10(abs(mean)))) if mean else 0
    places = max(digits - 1 - magnitude, 0)
    return f'{mean:.{places}f}' + ('' if np.isnan(std) else f' ± {std:.{places}f}')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = frame.experiment_options('fig3', __doc__, TRIALS, QUICK_TRIALS, arguments)
    return run_command(lambda: reproduce(options))


if __name__ == '__main__':
    raise SystemExit(main())
