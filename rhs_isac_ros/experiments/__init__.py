"""Experiments of many independent trials: running, storing and reporting them."""

from rhs_isac_ros.experiments.command import (
    markdown_table,
    mean_and_std,
    parse_options,
    plus_minus,
    run_command,
)
from rhs_isac_ros.experiments.jobs import Job, JobError, ResultStore, run_jobs
from rhs_isac_ros.support.arguments import positive_int
from rhs_isac_ros.support.optional import MissingLibraryError

__all__ = [
    'Job', 'JobError', 'MissingLibraryError', 'ResultStore', 'markdown_table', 'mean_and_std',
    'parse_options', 'plus_minus', 'positive_int', 'run_command', 'run_jobs',
]
