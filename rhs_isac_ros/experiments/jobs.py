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

    `name` is the name of the result file without suffix, unique in its folder; `arguments` are
    keyword arguments of the function, JSON serialisable.
    """

    name: str
    arguments: Mapping[str, Any]


class JobResult(NamedTuple):
    """Result of a job as JSON in `text`, or the text of its error in `error`; the other is empty.

    `version` is that of this package in the process that ran the job.
    """

    job: Job
    text: str = ''
    error: str = ''
    version: str = __version__


def attempt(function: Callable[..., Mapping[str, Any]], job: Job) -> JobResult:
    """Run a job in the current process.

    The function takes the job's arguments and returns a mapping that JSON can serialise.
    Exceptions are returned as text, because not all of them can be pickled.
    """
    try:
        return JobResult(job, text=json.dumps(function(**job.arguments)))
    except MissingLibraryError as error:
        return JobResult(job, error=str(error))
    except Exception:
        return JobResult(job, error=traceback.format_exc())
