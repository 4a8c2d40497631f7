"""The command line of a benchmark, and the file of its results."""

import json
from pathlib import Path
from typing import Any

from rhs_isac_ros.support.arguments import ArgumentParser, HelpFormatter, output_file, seed
from rhs_isac_ros.support.files import write_whole


def benchmark_parser(
        name: str, description: str | None, default_seed: int | None = 1) -> ArgumentParser:
    """Return a parser with the options ``--json`` and, if it has a default, ``--seed``."""
    parser = ArgumentParser(
        prog=f'scripts/benchmark {name}', description=description, formatter_class=HelpFormatter)
    if default_seed is not None:
        parser.add_argument('--seed', type=seed, default=default_seed,
                            help='seed of all random numbers')
    parser.add_argument('--json', type=output_file, help='JSON file for the results')
    return parser


def write_results(path: Path | None, results: Any) -> None:
    """Write results if a file was given."""
    if path:
        write_whole(path, json.dumps(results, indent=2) + '\n')
