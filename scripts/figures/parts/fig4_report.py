"""The report of Fig. 4: tables, verdicts on the paper's claims, picture and CSV files."""

import argparse
import io

import numpy as np
from parts import fig4_claims
from parts.fig4_results import Condition, Results

from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.model.optional import optional_import


def write(results: Results, options: argparse.Namespace) -> None:
    """Print the report and write it with the picture and the data."""
    report = '\n\n'.join([
        f'{len(results.truth)} test positions; {options.trials} trainings with {options.pairs} '
        'pairs each, and the random codebook drawn anew for each. Brackets contain 95 % '
        'intervals over positions, trainings and drawn codebooks. A claim holds if the whole '
        'interval is at least the claimed reduction, does not hold if the whole interval is below '
        'it, and is undecided otherwise.',
        '## Claims', fig4_claims.summary(results),
        *(text for condition in results.conditions for text in (
            f'## {condition}', table(results, condition),
            'Reduction relative to each benchmark:',
            fig4_claims.condition_table(results, condition)))])
    for name, text in csv_files(results).items():
        write_whole(options.output / name, text)
    write_whole(options.output / 'fig4.png', picture(results))
    write_whole(options.output / 'fig4.md', f'# Fig. 4\n\n![Fig. 4](fig4.png)\n\n{report}\n')
    print(f'{report}\n\nwritten: {options.output}/fig4.png, fig4.md, fig4a.csv and fig4b.csv')


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


def picture(results: Results) -> bytes:
    """Draw (a) errors, one dot per trial and their interval, (b) box plots of the losses."""
    with optional_import('drawing the figure', extra='plot'):
        from matplotlib.figure import Figure
    conditions, rows = results.conditions, results.rows
    figure = Figure(figsize=(9, 8), layout='constrained')
    upper, lower = figure.subplots(2, 1, sharex=True)
    shifts = (np.arange(len(conditions)) - (len(conditions) - 1) / 2) * 0.8 / len(conditions)
    for index, (condition, shift) in enumerate(zip(conditions, shifts, strict=True)):
        color = f'C{index}'
        for x, row in enumerate(rows):
            mse, low, high = results.statistics(condition, row)['error'].interval()
            mses = np.nanmean(results.errors_m2(condition, row), axis=1)
            upper.plot(np.full(len(mses), x + shift), mses, '.', color=color, alpha=0.5)
            upper.errorbar(x + shift, mse, [[mse - low], [high - mse]], fmt='x', color=color,
                           capsize=3, label=str(condition) if x == 0 else None)
            if (condition, row) in results.losses:
                box = lower.boxplot(
                    np.nanmax(results.losses[condition, row], axis=0) / 1e3,
                    positions=[x + shift], widths=0.6 / len(conditions), showfliers=False,
                    patch_artist=True, medianprops={'color': 'k'})
                box['boxes'][0].set(facecolor=color, alpha=0.6)
    upper.set(ylabel='(a) mean squared error [m²]', yscale='log')
    # Logarithmic above 1 kbit/s. The search for a beam ends slightly below the maximum, so that
    # losses may be slightly negative.
    lower.set(ylabel='(b) capacity loss [kbit/s]', yscale='symlog')
    lower.set_ylim(bottom=-0.5)
    lower.set_xticks(range(len(rows)), rows)
    upper.legend(fontsize='small', ncols=2)
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=110)
    return stream.getvalue()
