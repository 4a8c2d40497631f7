"""The report of Fig. 4: tables, verdicts on the paper's claims, picture and CSV files."""

import argparse
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from parts import frame
from parts.fig4_results import NEURAL, SCANS, Condition, Results

from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.support.pictures import PAGE_IN, look, new_panels, paper_style

# Whiskers of the box plots [%].
WHISKERS = (5, 95)
# Reductions that the paper claims for its codebook, by quantity and benchmark [%].
CLAIMS = {'error': {'directional': 42, 'random': 69},
          'median loss': {'directional': 82, 'random': 86},
          'range of the loss': {'directional': 50, 'random': 64}}
QUANTITIES = {'error': 'mean squared error', 'median loss': 'median capacity loss',
              'range of the loss': 'interquartile range of the loss'}
# Codebooks that the claims are tested for; that of the paper is the first.
OWN = ('algorithm-1', 'crlb', 'ambiguity')
# Verdicts need as many positions, and several trainings of a network.
MIN_POSITIONS, MIN_TRAININGS = 10_000, 2


class Finding(NamedTuple):
    """Reduction of a quantity by a codebook relative to a benchmark [%], and the verdict."""

    percent: float
    low: float
    high: float
    verdict: str

    def __str__(self) -> str:
        """Return the entry of a table."""
        return f'{self.percent:.0f} % [{self.low:.0f}, {self.high:.0f}], {self.verdict}'


def verdict(claimed: float, low: float, high: float, positions: int, trainings: int) -> str:
    """Compare the interval of a reduction with the claimed one.

    The claim holds if the whole interval is at least the claimed reduction, and does not hold if
    the whole interval is below it.
    """
    if positions < MIN_POSITIONS:
        return 'too few positions'
    if trainings < MIN_TRAININGS:
        return 'too few trainings'
    return 'holds' if low >= claimed else 'does not hold' if high < claimed else 'undecided'


def claims_of(results: Results) -> Iterator[tuple[str, str, int]]:
    """Yield quantity, benchmark and claimed reduction of each claim about the measured rows."""
    for quantity, by_kind in CLAIMS.items():
        for benchmark in results.rows:
            kind = 'directional' if benchmark in SCANS else benchmark
            if kind in by_kind and any(quantity in results.statistics(condition, benchmark)
                                       for condition in results.conditions):
                yield quantity, benchmark, by_kind[kind]


def finding(results: Results, condition: Condition, quantity: str, own: str, benchmark: str,
            claimed: int) -> Finding:
    """Compare a codebook with a benchmark in a condition."""
    percent, low, high = results.statistics(condition, own)[quantity].reduction_from(
        results.statistics(condition, benchmark)[quantity])
    trainings = MIN_TRAININGS
    if quantity == 'error':
        positions = len(results.truth)
        if condition.estimator == NEURAL:
            trainings = min(len(results.estimates[condition, row]) for row in (own, benchmark))
    else:
        positions = results.losses[condition, own].shape[1]
    return Finding(percent, low, high, verdict(claimed, low, high, positions, trainings))


def claims_table(results: Results, columns: Mapping[str, tuple[Condition, str]]) -> str:
    """Return a row for each claim; a column tests it in a condition for one of our codebooks."""
    return markdown_table(['claim', *columns], [
        [f'{QUANTITIES[quantity]} {claimed} % below {benchmark}',
         *(str(finding(results, condition, quantity, own, benchmark, claimed))
           if quantity in results.statistics(condition, own) else ''
           for condition, own in columns.values())]
        for quantity, benchmark, claimed in claims_of(results)])


def write(results: Results, options: argparse.Namespace) -> None:
    """Print the report and write it with the picture and the data."""
    own = [name for name in OWN if name in results.rows]
    report = '\n\n'.join([
        f'{len(results.truth)} test positions; {options.trials} trainings with {options.pairs} '
        'pairs each, and the random codebook drawn anew for each. Brackets contain 95 % '
        'intervals over positions, trainings and drawn codebooks. A claim holds if the whole '
        'interval is at least the claimed reduction, does not hold if the whole interval is below '
        'it, and is undecided otherwise.',
        *(text for name in own[:1] for text in (f'## Claims about {name}', claims_table(
            results, {str(condition): (condition, name) for condition in results.conditions}))),
        *(text for condition in results.conditions for text in (
            f'## {condition}', table(results, condition),
            'Reduction relative to each benchmark:',
            claims_table(results, {name: (condition, name) for name in own})))])
    frame.write_report(options, 'fig4', 'Fig. 4', report, picture(results), csv_files(results))


def table(results: Results, condition: Condition) -> str:
    """Return a table of errors and losses with a row for each codebook."""
    rows = []
    for row in results.rows:
        values = results.statistics(condition, row)
        mse, low, high = values['error'].interval()
        per_trial = np.nanmean(results.errors_m2(condition, row), axis=1)
        spread = f'{per_trial.std(ddof=1):.3g}' if len(per_trial) > 1 else '–'
        losses = [f'{values[name].values[0] / 1e3:.3g}' if name in values else '–'
                  for name in ('median loss', 'range of the loss')]
        rows.append([row, f'{mse:.3g} [{low:.3g}, {high:.3g}]', spread, str(len(per_trial)),
                     *losses, str(results.without_fix[condition, row])])
    return markdown_table(
        ['codebook', 'MSE [m²]', 'its deviation between trials', 'trials',
         'median loss [kbit/s]', 'interquartile range [kbit/s]', 'without fix'], rows)


def csv_files(results: Results) -> dict[str, str]:
    """Return the data of both panels as CSV, by file name."""
    first = ['condition,codebook,trial,mse_m2,validation_mse_m2']
    second = ['condition,codebook,position,loss_bps']
    for (condition, row), validation in results.validation_m2.items():
        mses = np.nanmean(results.errors_m2(condition, row), axis=1)
        first += [f'{condition.slug},{row},{trial},{mse:.6g},{other:.6g}' for trial, (mse, other)
                  in enumerate(zip(mses, validation, strict=True))]
    for (condition, row), losses in results.losses.items():
        second += [f'{condition.slug},{row},{position},{loss:.6g}'
                   for position, loss in enumerate(np.nanmax(losses, axis=0))]
    return {name: '\n'.join(lines) + '\n'
            for name, lines in (('fig4a.csv', first), ('fig4b.csv', second))}


@paper_style('drawing the figure')
def picture(results: Results) -> Any:
    """Draw (a) the mean squared errors, and (b) box plots of the losses if there are any."""
    conditions, rows = results.conditions, results.rows
    figure, ((upper,), *others), above = new_panels(
        PAGE_IN, 5.6 if results.losses else 3.2, 1 + bool(results.losses), 1, sharex=True)
    # Each row has a strip; conditions share it.
    width = 0.8 / len(conditions)
    shifts = (np.arange(len(conditions)) - (len(conditions) - 1) / 2) * width
    for index, (condition, shift) in enumerate(zip(conditions, shifts, strict=True)):
        own, label = look(index), str(condition).replace('-', '−')
        for x, row in enumerate(rows):
            mse, low, high = results.statistics(condition, row)['error'].interval()
            mses = np.nanmean(results.errors_m2(condition, row), axis=1)
            upper.plot(np.full(len(mses), x + shift - 0.25 * width), mses, own.marker,
                       color=own.colour, markersize=2.5, markerfacecolor='none')
            upper.errorbar(x + shift, mse, [[mse - low], [high - mse]], fmt=own.marker,
                           color=own.colour, label=label if row == rows[0] else None)
            if (condition, row) in results.losses:
                box = others[0][0].boxplot(
                    np.nanmax(results.losses[condition, row], axis=0), positions=[x + shift],
                    widths=0.7 * width, showfliers=False, patch_artist=True, whis=WHISKERS)
                box['boxes'][0].set(**box_style(index))
    upper.set(ylabel='mean squared error [m$^2$]', yscale='log', title='(a)')
    lowest = upper
    for (lowest,) in others:
        lowest.set(ylabel='capacity loss of band 1 [bit/s]', yscale='log', title='(b)',
                   ylim=loss_limits_bps(results))
    for axes in (upper, *(lower for (lower,) in others)):
        axes.grid(axis='y')
        # Not a grid of the axis, which would go through the middle of a strip.
        for x in np.arange(len(rows) - 1) + 0.5:
            axes.axvline(x, color='0.7', linewidth=0.5)
    lowest.set_xticks(range(len(rows)), rows)
    lowest.set(xlabel='codebook', xlim=(-0.5, len(rows) - 0.5))
    add_legend(above, upper, bool(results.losses))
    return figure


def box_style(index: int) -> dict[str, Any]:
    """Return the style of the boxes of a condition by its index."""
    from matplotlib.colors import to_rgb

    own = look(index)
    # Mixed with white, because not every format has transparency.
    return {'facecolor': 0.6 + 0.4 * np.array(to_rgb(own.colour)), 'edgecolor': own.colour,
            'hatch': own.hatch}


def loss_limits_bps(results: Results) -> tuple[float, float]:
    """Return the range of the losses in the picture, in which every box is visible.

    The search for a beam ends slightly below the maximum, so that losses may be slightly negative.
    """
    losses = [np.nanmax(own, axis=0) for own in results.losses.values()]
    high = max(np.percentile(own, WHISKERS[1]) for own in losses)
    quartiles = np.array([np.percentile(own, 25) for own in losses])
    low = quartiles[quartiles > 0].min(initial=high)
    return low / 20, 2 * high


def add_legend(above: Any, upper: Any, has_losses: bool) -> None:
    """Add the conditions, and the meaning of each mark."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles, labels = upper.get_legend_handles_labels()
    if has_losses:
        # The colour of a box under the marker.
        handles = [(Patch(**box_style(index)), handle) for index, handle in enumerate(handles)]
    marks = [(Line2D([], [], linestyle='', marker='o', markersize=2.5, markerfacecolor='none',
                     color='0.3'), '(a): a single trial')]
    mean = above.errorbar([0], [0], [1], fmt='o', color='0.3')
    mean.remove()
    marks.append((mean, 'mean and its 95 % interval'))
    if has_losses:
        marks += [(Patch(facecolor='0.85', edgecolor='0.3'), '(b): quartiles'),
                  (Line2D([], [], color='black', linewidth=1.4), 'median'),
                  (Line2D([], [], color='black', linewidth=0.8, marker='_', markersize=6),
                   '{} to {} %, or beyond the scale'.format(*WHISKERS))]
    handles += [handle for handle, _ in marks]
    above.legend(handles, labels + [label for _, label in marks], loc='lower center', ncols=3)
