"""The notebooks of the documentation, executed once for all tests."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / 'docs'
# The extensions import each other by name, as Sphinx imports them.
sys.path.insert(0, str(DOCS / 'extensions'))


@pytest.fixture(scope='session')
def notebooks(tmp_path_factory):
    """Processes that executed the notebooks, by name, and the folder of their results."""
    folder = tmp_path_factory.mktemp('notebooks')

    def execute(source):
        return source.stem, subprocess.run(
            [sys.executable, DOCS / 'extensions' / 'run_notebook.py', source,
             folder / f'{source.stem}.ipynb'],
            capture_output=True, text=True, timeout=240, check=False,
            env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})
    with ThreadPoolExecutor(2) as pool:
        return dict(pool.map(execute, (DOCS / 'notebooks').glob('*.md'))), folder
