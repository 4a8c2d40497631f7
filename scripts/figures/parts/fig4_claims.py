"""The paper's claims about Fig. 4, tested against results."""

from collections.abc import Iterator
from typing import NamedTuple

from parts.fig4_results import NEURAL, SCANS, Condition, Results

from rhs_isac_ros.experiments import markdown_table

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
HOLDS, FAILS, OPEN = 'holds', 'does not hold', 'undecided'
TOO_FEW = 'too few positions'


class Finding(NamedTuple):
    """Reduction of a quantity by a codebook relative to a benchmark, and the verdict."""

    condition: Condition
    quantity: str
    own: str
    benchmark: str
    claimed: int
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
        return TOO_FEW
    if trainings < MIN_TRAININGS:
        return 'too few trainings'
    return HOLDS if low >= claimed else FAILS if high < claimed else OPEN


def findings(results: Results, condition: Condition) -> Iterator[Finding]:
    """Compare each of our codebooks with each benchmark in a condition."""
    for quantity, by_kind in CLAIMS.items():
        for benchmark in results.rows:
            kind = 'directional' if benchmark in SCANS else benchmark
            for own in OWN:
                if own in results.rows and kind in by_kind and (
                        quantity in results.statistics(condition, own)):
                    yield _finding(results, condition, quantity, own, benchmark, by_kind[kind])


def _finding(results: Results, condition: Condition, quantity: str, own: str, benchmark: str,
             claimed: int) -> Finding:
    percent, low, high = results.statistics(condition, own)[quantity].reduction_from(
        results.statistics(condition, benchmark)[quantity])
    trainings = MIN_TRAININGS
    if quantity == 'error':
        positions = len(results.truth)
        if condition.estimator == NEURAL:
            trainings = min(len(results.estimates[condition, row]) for row in (own, benchmark))
    else:
        positions = results.losses[condition, own].shape[1]
    return Finding(condition, quantity, own, benchmark, claimed, percent, low, high,
                   verdict(claimed, low, high, positions, trainings))


def condition_table(results: Results, condition: Condition) -> str:
    """Return a table of the reductions in a condition: a row per claim, a column per codebook."""
    rows: dict[tuple[str, str, int], dict[str, str]] = {}
    for found in findings(results, condition):
        key = found.quantity, found.benchmark, found.claimed
        rows.setdefault(key, {})[found.own] = str(found)
    own = [name for name in OWN if name in results.rows]
    return markdown_table(
        ['claim', 'paper', *own],
        [[f'{QUANTITIES[quantity]}, below {benchmark}', f'{claimed} %',
          *(cells.get(name, '') for name in own)]
         for (quantity, benchmark, claimed), cells in rows.items()])


def summary(results: Results) -> str:
    """Return the verdicts for the paper's codebook: a row per claim, a column per condition."""
    own = next(name for name in OWN if name in results.rows)
    rows: dict[tuple[str, str, int], dict[Condition, str]] = {}
    for condition in results.conditions:
        for found in findings(results, condition):
            if found.own == own:
                key = found.quantity, found.benchmark, found.claimed
                rows.setdefault(key, {})[condition] = str(found)
    return markdown_table(
        [f'claim about {own}', *map(str, results.conditions)],
        [[f'{QUANTITIES[quantity]} {claimed} % below {benchmark}',
          *(cells.get(condition, '') for condition in results.conditions)]
         for (quantity, benchmark, claimed), cells in rows.items()])
