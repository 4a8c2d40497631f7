"""Band plans with the same spectrum, power and number of pilots."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.experiments.sweep import OPTIMIZE, with_power
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.support.arguments import input_file, positive_int

# Seed of all positions, signals and codebooks.
SEED = 1


class Plan(NamedTuple):
    """A plan: its deviations from Table I, and the file of its codebook unless it is optimised."""

    changes: Mapping[str, Any]
    codebook: str = OPTIMIZE


PLANS = {
    '2 bands (Table I)': Plan({}),
    '4 equally spaced': Plan({
        'center_frequencies_hz': [2.5e9, 2.5e9 + 5e8 / 3, 2.5e9 + 1e9 / 3, 3.0e9],
        'n_frames': 2}),
    # Many different distances.
    '4 unequally spaced': Plan({
        'center_frequencies_hz': [2.5e9, 2.55e9, 2.7e9, 3.0e9], 'n_frames': 2})}


def read_plans(files: Sequence[tuple[Path, Path]]) -> dict[str, Plan]:
    """Return the built-in plans and those of pairs of a scenario and a codebook file."""
    return PLANS | {
        scenario.stem: Plan(Scenario.from_yaml(scenario).changes(), str(codebook))
        for scenario, codebook in files}


def add_plan_options(parser: argparse.ArgumentParser, steps: int, quick_steps: int) -> None:
    """Add the options for further plans and for the optimisation."""
    parser.add_argument('--plan', type=input_file, nargs=2, action=_Pair, default=[],
                        metavar=('SCENARIO', 'CODEBOOK'), help='another plan and its codebook')
    parser.add_argument('--steps', type=positive_int, metavar='N',
                        help=f'steps of an optimisation (default: {steps}, quick {quick_steps})')


class _Pair(argparse.Action):
    """Adds a scenario and its codebook, which are checked before anything runs."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 values: Any, option_string: str | None = None) -> None:
        """Add the files."""
        (scenario_file, codebook_file), known = values, getattr(namespace, self.dest)
        if scenario_file.stem in [*PLANS, *(scenario.stem for scenario, _ in known)]:
            parser.error(f'argument {option_string}: {scenario_file.stem} more than once, '
                         'expected different names')
        try:
            scenario, codebook = Scenario.from_yaml(scenario_file), Codebook.load(codebook_file)
        except (CodebookError, ScenarioError) as error:
            parser.error(f'argument {option_string}: {error}')
        try:
            with_power(codebook, scenario.max_power_w).check(scenario)
        except CodebookError as error:
            parser.error(f'argument {option_string}: {codebook_file}: {error}')
        setattr(namespace, self.dest, [*known, (scenario_file, codebook_file)])
