"""Experiments of many independent jobs: running them, storing results and formatting tables."""

from rhs_isac_ros.experiments.jobs import Job, JobError, markdown_table, run_command, run_jobs

__all__ = ['Job', 'JobError', 'markdown_table', 'run_command', 'run_jobs']
