"""Experiments of many independent trials: running, storing and reporting them."""

from rhs_isac_ros.experiments.jobs import Job, JobError, markdown_table, run_command, run_jobs

__all__ = ['Job', 'JobError', 'markdown_table', 'run_command', 'run_jobs']
