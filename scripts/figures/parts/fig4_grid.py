"""The reading of the paper that matches its errors best: a search after the fact."""

import argparse

import numpy as np
from parts.fig4_claims import CLAIMS, OWN, Finding, findings
from parts.fig4_results import SCANS, Results

from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.support.files import write_whole


def write(results: Results, options: argparse.Namespace) -> None:
    """Print the readings, the best match first, and write the report."""
    ranked = readings(results)
    report = '\n\n'.join([
        f'{len(ranked)} readings of the paper, ordered by the distance of the two reductions of '
        f'the mean squared error from the paper\'s, {CLAIMS["error"]["directional"]} and '
        f'{CLAIMS["error"]["random"]} %. {len(results.truth)} positions, {options.trials} '
        f'trainings with {options.pairs} pairs. The brackets contain 95 % intervals of each '
        'reading alone.',
        table(ranked),
        'This is a match after the fact. The search selects the reading by the result that it is '
        'to explain, so that the best match is no evidence for the claims.'])
    write_whole(options.output / 'fig4_grid.md', f'# Readings of Fig. 4\n\n{report}\n')
    print(f'{report}\n\nwritten: {options.output}/fig4_grid.md')


def readings(results: Results) -> list[tuple[float, Finding, Finding]]:
    """Return distance, and reductions below a scan and below random, sorted by distance."""
    ranked = []
    for condition in results.conditions:
        errors = {(found.own, found.benchmark): found for found in findings(results, condition)
                  if found.quantity == 'error'}
        for own in OWN:
            for scan in SCANS:
                pair = errors.get((own, scan)), errors.get((own, 'random'))
                if pair[0] and pair[1]:
                    distance = np.hypot(*(found.percent - found.claimed for found in pair))
                    ranked.append((float(distance), *pair))
    return sorted(ranked, key=lambda entry: entry[0])


def table(ranked: list[tuple[float, Finding, Finding]]) -> str:
    """Return a table with a row for each reading."""
    return markdown_table(
        ['condition', 'codebook', 'directional', 'below it', 'below random', 'distance'],
        [[str(scan.condition), scan.own, scan.benchmark, _reduction(scan), _reduction(random),
          f'{distance:.0f}'] for distance, scan, random in ranked])


def _reduction(found: Finding) -> str:
    return f'{found.percent:.0f} % [{found.low:.0f}, {found.high:.0f}]'
