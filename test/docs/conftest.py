"""The pages of the documentation, built once for all tests."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / 'docs'
# The extensions import each other by name, as Sphinx imports them.
sys.path.insert(0, str(DOCS / 'extensions'))


@pytest.fixture(scope='session')
def build(tmp_path_factory):
    """Folder of a build with the command of scripts/docs, which must not warn."""
    for library in ('furo', 'matplotlib', 'myst_nb', 'sphinx'):
        pytest.importorskip(library, reason=f'{library} is not installed')
    pytest.importorskip('rclpy', reason='the pages of the interfaces need ROS')
    folder = tmp_path_factory.mktemp('docs')
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-E', '-q', '-b', 'html',
         '-w', folder / 'warnings', '-d', folder / 'doctrees', DOCS, folder / 'html'],
        capture_output=True, text=True, timeout=1200, check=False,
        # A proxy that does not exist: reading from the network fails.
        env={**os.environ, 'http_proxy': 'http://127.0.0.1:9', 'https_proxy': 'http://127.0.0.1:9',
             'OPENBLAS_NUM_THREADS': '1'})
    warnings = (folder / 'warnings').read_text(encoding='utf-8')
    # Without standard error: the kernel of a notebook may print to it while it shuts down.
    assert (done.returncode, done.stdout, warnings) == (0, '', ''), done.stderr
    return folder


@pytest.fixture(scope='session')
def site(build):
    """Folder of the pages."""
    return build / 'html'


@pytest.fixture(scope='session')
def printed(build):
    """Callable that returns all that a notebook prints."""
    def of(name):
        path = build / 'jupyter_execute' / 'notebooks' / f'{name}.ipynb'
        cells = json.loads(path.read_text(encoding='utf-8'))['cells']
        return ''.join(line for cell in cells for output in cell.get('outputs', ())
                       if output['output_type'] == 'stream' for line in output['text'])
    return of
