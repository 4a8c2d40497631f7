"""Experiments of many jobs: sweeps, and the functions of `support.jobs` for own ones."""

from rhs_isac_ros.support.jobs import Job, JobError, markdown_table, run_command, run_jobs

__all__ = ['Job', 'JobError', 'markdown_table', 'run_command', 'run_jobs']
