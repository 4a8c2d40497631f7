"""Running experiments of many independent trials, and reporting on them."""

from rhs_isac_ros.experiments.command import parse_options, positive, run_command
from rhs_isac_ros.experiments.jobs import Job, JobError
from rhs_isac_ros.experiments.libraries import MissingLibraryError
from rhs_isac_ros.experiments.report import markdown_table, mean_and_std, plus_minus
from rhs_isac_ros.experiments.store import ResultStore
from rhs_isac_ros.experiments.trials import run_jobs

__all__ = [
    'Job', 'JobError', 'MissingLibraryError', 'ResultStore', 'markdown_table', 'mean_and_std',
    'parse_options', 'plus_minus', 'positive', 'run_command', 'run_jobs',
]
