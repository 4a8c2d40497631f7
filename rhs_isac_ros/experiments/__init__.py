"""Experiments of many independent trials: running, storing and reporting them."""

from rhs_isac_ros.experiments.command import parse_options, run_command
from rhs_isac_ros.experiments.jobs import Job, JobError
from rhs_isac_ros.experiments.report import markdown_table, mean_and_std, plus_minus
from rhs_isac_ros.experiments.store import ResultStore
from rhs_isac_ros.experiments.trials import run_jobs
from rhs_isac_ros.model.arguments import positive_int
from rhs_isac_ros.model.optional import MissingLibraryError

__all__ = [
    'Job', 'JobError', 'MissingLibraryError', 'ResultStore', 'markdown_table', 'mean_and_std',
    'parse_options', 'plus_minus', 'positive_int', 'run_command', 'run_jobs',
]
