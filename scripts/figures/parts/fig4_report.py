"""What Fig. 4 says: its table, the claims of the paper beside it, the picture and the numbers."""

import io
from collections.abc import Mapping, Sequence

import numpy as np

from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.experiments.libraries import needed_for
from rhs_isac_ros.experiments.resampling import reduction

ESTIMATORS = ('neural', 'bayes')
# What the paper claims of `optimised` against each benchmark, in per cent, and of what.
CLAIMS = {'mean squared error': {'directional': 42, 'random': 69},
          'median capacity loss': {'directional': 82, 'random': 86},
          'interquartile range of the loss': {'directional': 50, 'random': 64}}


class Summary:
    """What was measured: errors of every training, and everybody's losses at every position.

    Parameters
    ----------
    names
        Codebooks.
    mses
        Mean squared errors of the trials by estimator and codebook [m^2].
    losses
        Losses by ``estimator codebook``, float64 [n, 2] [bit/s, per cent].
    """

    def __init__(self, names: Sequence[str], mses: Mapping[tuple[str, str], np.ndarray],
                 losses: Mapping[str, np.ndarray]) -> None:
        self.names, self.mses, self.losses = tuple(names), mses, losses

    def table(self) -> str:
        """One row for each estimator and codebook."""
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
            ['estimator, codebook', 'MSE [m²]', 'the best', 'median loss [kbit/s]',
             'interquartile range [kbit/s]', 'median loss [%]'], rows)

    def claims(self) -> str:
        """What the paper claims beside what is measured, with 95 % intervals."""
        rows = []
        for what, rivals in CLAIMS.items():
            for rival, claimed in rivals.items():
                row = [f'{what}, below {rival}', f'{claimed} %']
                for estimator, own in (('neural', 'optimised'), ('bayes', 'optimised'),
                                       ('bayes', 'ambiguity')):
                    row.append(self._reduction(what, estimator, own, rival))
                rows.append(row)
        return markdown_table(
            ['claim', 'paper', 'neural, optimised', 'bayes, optimised', 'bayes, ambiguity'], rows)

    def _reduction(self, what: str, estimator: str, own: str, rival: str) -> str:
        def of(name: str) -> np.ndarray:
            if what == 'mean squared error' and estimator == 'neural':
                return self.mses[estimator, name]
            column = 2 if what == 'mean squared error' else 0
            return self.losses[f'{estimator} {name}'][:, column]

        statistic = {
            'mean squared error': lambda values: values.mean(axis=-1),
            'median capacity loss': lambda values: np.median(values, axis=-1),
            'interquartile range of the loss':
                lambda values: np.subtract(*np.quantile(values, (0.75, 0.25), axis=-1))}[what]
        less, low, high = reduction(of(own), of(rival), statistic)
        return f'{less:.0f} % [{low:.0f}, {high:.0f}]'


def picture(summary: Summary) -> bytes:
    """Draw (a), trainings as dots in their distribution, and (b), the losses as boxes."""
    with needed_for('drawing the figure'):
        from matplotlib.figure import Figure
    figure = Figure(figsize=(11, 4), layout='constrained')
    left, right = figure.subplots(1, 2)
    places = np.arange(len(summary.names))
    for shift, estimator, colour in zip((-0.2, 0.2), ESTIMATORS, ('C0', 'C1'), strict=True):
        for place, name in zip(places + shift, summary.names, strict=True):
            mses = summary.mses[estimator, name]
            if len(mses) > 2 and np.ptp(mses) > 0:
                bodies = left.violinplot(mses, [place], widths=0.35, showextrema=False)['bodies']
                bodies[0].set(facecolor=colour, alpha=0.3)
            left.plot(np.full(len(mses), place), mses, '.', color=colour, alpha=0.6)
            left.plot(place, mses.mean(), 'x', color='k')
            box = right.boxplot(
                summary.losses[f'{estimator} {name}'][:, 0] / 1e3, positions=[place],
                widths=0.3, showfliers=False, patch_artist=True)
            box['boxes'][0].set(facecolor=colour, alpha=0.5)
        left.plot([], [], 's', color=colour, alpha=0.5, label=estimator)
    for axes, label in ((left, '(a) mean squared error [m²]'), (right, '(b) loss [kbit/s]')):
        axes.set_xticks(places, summary.names)
        axes.set(ylabel=label)
    left.set(ylim=(0, None))
    left.legend()
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=120)
    return stream.getvalue()


def tables(summary: Summary) -> dict[str, str]:
    """The numbers behind both panels, as CSV."""
    lines = {'fig4a.csv': ['estimator,codebook,training,mse_m2'],
             'fig4b.csv': ['estimator,codebook,position,loss_bps,loss_percent,squared_error_m2']}
    for estimator in ESTIMATORS:
        for name in summary.names:
            lines['fig4a.csv'] += [f'{estimator},{name},{trial},{mse:.6g}' for trial, mse
                                   in enumerate(summary.mses[estimator, name])]
            lines['fig4b.csv'] += [
                f'{estimator},{name},{place},' + ','.join(f'{value:.6g}' for value in row)
                for place, row in enumerate(summary.losses[f'{estimator} {name}'])]
    return {name: '\n'.join(rows) + '\n' for name, rows in lines.items()}
