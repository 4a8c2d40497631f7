"""A folder with the result of each finished job."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rhs_isac_ros import __version__
from rhs_isac_ros.experiments.jobs import Job
from rhs_isac_ros.model.files import write_whole


class ResultStore:
    """Keeps results between runs, each in a small file of JSON.

    Parameters
    ----------
    folder
        Where; it is made if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def path(self, job: Job) -> Path:
        """Return where the result of a job is kept.

        Parameters
        ----------
        job
            The job.

        Returns
        -------
        Path
            The file; it need not be there.
        """
        return self._folder / f'{job.name}.json'

    def read(self, job: Job) -> dict[str, Any] | None:
        """Return the result of a job if it is known.

        Parameters
        ----------
        job
            The job.

        Returns
        -------
        dict or None
            None if there is no file, if it is damaged, or if it is of other arguments or of
            another version of this package.
        """
        try:
            record = json.loads(self.path(job).read_bytes())
        except (FileNotFoundError, ValueError):
            return None
        if not isinstance(record, dict) or not isinstance(record.get('result'), dict):
            return None
        same = all(record.get(key) == value for key, value in self._settings(job).items())
        return record['result'] if same else None

    def write(self, job: Job, result: Mapping[str, Any]) -> None:
        """Keep the result of a job; one that is there is replaced.

        Parameters
        ----------
        job
            The job.
        result
            What it returned.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        record = {**self._settings(job), 'result': result}
        write_whole(self.path(job), json.dumps(record, indent=1) + '\n')

    @staticmethod
    def _settings(job: Job) -> dict[str, Any]:
        """What must agree, as JSON returns it: a list for a tuple."""
        return json.loads(json.dumps({'version': __version__, 'arguments': dict(job.arguments)}))
