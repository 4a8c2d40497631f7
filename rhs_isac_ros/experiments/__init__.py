"""Experiments of many jobs: sweeps, and the functions of `support.jobs` for own ones."""

from rhs_isac_ros.support.job_commands import run_command
from rhs_isac_ros.support.jobs import Job, JobError, run_jobs
from rhs_isac_ros.support.texts import markdown_table

__all__ = ['Job', 'JobError', 'markdown_table', 'run_command', 'run_jobs']
