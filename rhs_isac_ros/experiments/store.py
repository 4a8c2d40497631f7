"""Results of finished jobs, in a folder."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rhs_isac_ros import __version__
from rhs_isac_ros.experiments.jobs import Job
from rhs_isac_ros.model.files import write_whole


class ResultStore:
    """Folder with one JSON file per result, which later runs reuse; it is created if necessary."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def path(self, job: Job) -> Path:
        """Return the file of a job's result, which may not exist yet."""
        return self._folder / f'{job.name}.json'

    def read(self, job: Job) -> dict[str, Any] | None:
        """Return the stored result of a job.

        The result is None if there is no file, the file is damaged, or it was written for other
        arguments or by another version of this package.
        """
        try:
            record = json.loads(self.path(job).read_bytes())
        except (FileNotFoundError, ValueError):
            return None
        if not isinstance(record, dict) or not isinstance(record.get('result'), dict):
            return None
        if any(record.get(key) != value for key, value in _settings(job).items()):
            return None
        result: dict[str, Any] = record['result']
        return result

    def write(self, job: Job, result: Mapping[str, Any]) -> None:
        """Store the result of a job, replacing an existing one atomically, or raise OSError."""
        record = {**_settings(job), 'result': result}
        write_whole(self.path(job), json.dumps(record, indent=1) + '\n')


def _settings(job: Job) -> dict[str, Any]:
    """Return version and arguments as they are read back from JSON, which has no tuples."""
    settings = {'version': __version__, 'arguments': dict(job.arguments)}
    decoded: dict[str, Any] = json.loads(json.dumps(settings))
    return decoded
