"""A job: one independent piece of an experiment."""

import dataclasses
import json
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rhs_isac_ros import __version__


class JobError(Exception):
    """A job failed; the message names it."""


@dataclasses.dataclass(frozen=True)
class Job:
    """What to compute, and what to call it.

    Attributes
    ----------
    name
        Names the file of the result: unique among the jobs of a folder, and fit for a file name.
    arguments
        Keyword arguments of the experiment's function; plain values that JSON can hold.
    """

    name: str
    arguments: Mapping[str, Any]


class Outcome(NamedTuple):
    """What became of a job, in a form that any process can send to any other.

    Attributes
    ----------
    job
        The job.
    text
        Its result as JSON; empty if it failed.
    error
        Why it failed; empty if it did not.
    version
        Version of this package where it ran.
    """

    job: Job
    text: str = ''
    error: str = ''
    version: str = __version__


def attempt(function: Callable[..., Mapping[str, Any]], job: Job) -> Outcome:
    """Do a job, wherever this is called.

    Exceptions become text: not every one survives the way to another process.

    Parameters
    ----------
    function
        Takes the job's arguments, and returns values by names that JSON can hold.
    job
        The job.

    Returns
    -------
    Outcome
        The result, or the traceback of what went wrong.
    """
    try:
        return Outcome(job, text=json.dumps(function(**job.arguments)))
    except Exception:
        return Outcome(job, error=traceback.format_exc())
