"""The report of Fig. 4: table, comparison with the paper's claims, picture and CSV files."""

import io
from collections.abc import Mapping, Sequence

import numpy as np

from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.experiments.resampling import reduction
from rhs_isac_ros.model.optional import optional_import

ESTIMATORS = ('neural', 'bayes')
# Reductions that the paper claims for `optimised`, by quantity and benchmark [%].
CLAIMS = {'mean squared error': {'directional': 42, 'random': 69},
          'median capacity loss': {'directional': 82, 'random': 86},
          'interquartile range of the loss': {'directional': 50, 'random': 64}}


class Summary:
    """Results: the error of every training, and losses and errors at every position.

    Parameters
    ----------
    names
        Names of the codebooks.
    mses
        Mean squared errors of the trials by estimator and codebook [m^2].
    losses
        Loss, relative loss and squared error by ``estimator codebook``, float64 [n, 3]
        [bit/s, per cent, m^2].
    """

    def __init__(self, names: Sequence[str], mses: Mapping[tuple[str, str], np.ndarray],
                 losses: Mapping[str, np.ndarray]) -> None:
        self.names, self.mses, self.losses = tuple(names), mses, losses

    def table(self) -> str:
        """Return a table with a row for each estimator and codebook."""
        rows = []
        for estimator in ESTIMATORS:
            for name in self.names:
                mses = self.mses[estimator, name]
                spread = f' ± {mses.std(ddof=1):.3f}' if len(mses) > 1 else ''
                low, median, high = np.quantile(
                    self.losses[f'{estimator} {name}'], (0.25, 0.5, 0.75), axis=0)
                rows.append([
                    f'{estimator}, {name}', f'{mses.mean():.3f}{spread}', f'{mses.min():.3f}',
                    f'{median[0] / 1e3:.1f}', f'{(high - low)[0] / 1e3:.1f}',
                    f'{median[1]:.3f}'])
        return markdown_table(
            ['estimator, codebook', 'MSE [m²]', 'best', 'median loss [kbit/s]',
             'interquartile range [kbit/s]', 'median loss [%]'], rows)

    def claims(self) -> str:
        """Return a table of the claimed and the measured reductions, with 95 % intervals."""
        rows = []
        for quantity, rivals in CLAIMS.items():
            for rival, claimed in rivals.items():
                row = [f'{quantity}, below {rival}', f'{claimed} %']
                for estimator, own in (('neural', 'optimised'), ('bayes', 'optimised'),
                                       ('bayes', 'ambiguity')):
                    row.append(self._reduction(quantity, estimator, own, rival))
                rows.append(row)
        return markdown_table(
            ['claim', 'paper', 'neural, optimised', 'bayes, optimised', 'bayes, ambiguity'], rows)

    def _reduction(self, quantity: str, estimator: str, own: str, rival: str) -> str:
        def values_of(name: str) -> np.ndarray:
            if quantity == 'mean squared error' and estimator == 'neural':
                return self.mses[estimator, name]
            column = 2 if quantity == 'mean squared error' else 0
            return self.losses[f'{estimator} {name}'][:, column]

        statistic = {
            'mean squared error': lambda values: values.mean(axis=-1),
            'median capacity loss': lambda values: np.median(values, axis=-1),
            'interquartile range of the loss':
                lambda values: np.subtract(*np.quantile(values, (0.75, 0.25), axis=-1))}[quantity]
        less, low, high = reduction(values_of(own), values_of(rival), statistic)
        return f'{less:.0f} % [{low:.0f}, {high:.0f}]'


def picture(summary: Summary) -> bytes:
    """Draw (a) errors, one dot per training over their distribution, (b) box plots of losses."""
    with optional_import('drawing the figure', extra='plot'):
        from matplotlib.figure import Figure
    figure = Figure(figsize=(11, 4), layout='constrained')
    left, right = figure.subplots(1, 2)
    centers = np.arange(len(summary.names))
    for shift, estimator, color in zip((-0.2, 0.2), ESTIMATORS, ('C0', 'C1'), strict=True):
        for x, name in zip(centers + shift, summary.names, strict=True):
            mses = summary.mses[estimator, name]
            if len(mses) > 2 and np.ptp(mses) > 0:
                bodies = left.violinplot(mses, [x], widths=0.35, showextrema=False)['bodies']
                bodies[0].set(facecolor=color, alpha=0.3)
            left.plot(np.full(len(mses), x), mses, '.', color=color, alpha=0.6)
            left.plot(x, mses.mean(), 'x', color='k')
            box = right.boxplot(
                summary.losses[f'{estimator} {name}'][:, 0] / 1e3, positions=[x],
                widths=0.3, showfliers=False, patch_artist=True)
            box['boxes'][0].set(facecolor=color, alpha=0.5)
        left.plot([], [], 's', color=color, alpha=0.5, label=estimator)
    for axes, label in ((left, '(a) mean squared error [m²]'), (right, '(b) loss [kbit/s]')):
        axes.set_xticks(centers, summary.names)
        axes.set(ylabel=label)
    left.set(ylim=(0, None))
    left.legend()
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=120)
    return stream.getvalue()


def tables(summary: Summary) -> dict[str, str]:
    """Return the data of both panels as CSV, by file name."""
    lines = {'fig4a.csv': ['estimator,codebook,training,mse_m2'],
             'fig4b.csv': ['estimator,codebook,position,loss_bps,loss_percent,squared_error_m2']}
    for estimator in ESTIMATORS:
        for name in summary.names:
            lines['fig4a.csv'] += [f'{estimator},{name},{trial},{mse:.6g}' for trial, mse
                                   in enumerate(summary.mses[estimator, name])]
            lines['fig4b.csv'] += [
                f'{estimator},{name},{position},' + ','.join(f'{value:.6g}' for value in row)
                for position, row in enumerate(summary.losses[f'{estimator} {name}'])]
    return {name: '\n'.join(rows) + '\n' for name, rows in lines.items()}
