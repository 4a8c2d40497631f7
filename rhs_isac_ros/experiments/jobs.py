"""Jobs: the independent parts of an experiment."""

import dataclasses
import json
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rhs_isac_ros import __version__
from rhs_isac_ros.model.optional import MissingLibraryError


class JobError(Exception):
    """A job failed; the message names it."""


@dataclasses.dataclass(frozen=True)
class Job:
    """A call of the function of an experiment.

    Attributes
    ----------
    name
        Name of the result file without suffix, unique in its folder.
    arguments
        Keyword arguments of the function, JSON serialisable.
    """

    name: str
    arguments: Mapping[str, Any]


class Outcome(NamedTuple):
    """Result or error of a job; can be pickled.

    Attributes
    ----------
    text
        The result as JSON; empty after an error.
    error
        The error as text; empty after success.
    version
        Version of this package in the process that ran the job.
    """

    job: Job
    text: str = ''
    error: str = ''
    version: str = __version__


def attempt(function: Callable[..., Mapping[str, Any]], job: Job) -> Outcome:
    """Run a job in the current process.

    Exceptions are returned as text, because not all of them can be pickled.

    Parameters
    ----------
    function
        Callable that takes the job's arguments and returns a mapping that JSON can serialise.
    """
    try:
        return Outcome(job, text=json.dumps(function(**job.arguments)))
    except MissingLibraryError as error:
        return Outcome(job, error=str(error))
    except Exception:
        return Outcome(job, error=traceback.format_exc())
