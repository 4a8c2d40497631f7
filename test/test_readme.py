"""The README says what the code says."""

import re
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook

ROOT = Path(__file__).parents[1]
README = (ROOT / 'README.md').read_text(encoding='utf-8')


def test_table_of_parameters_is_current():
    parameters = pytest.importorskip('rhs_isac_ros.ros.parameters')
    assert parameters.table() in README


def test_table_of_topics_names_every_topic():
    topics = pytest.importorskip('rhs_isac_ros.ros.topics')
    rows = re.findall(r'^\| `([a-z_/]+)`[^|]*\| `([A-Za-z_/]+)`', README, re.MULTILINE)
    types = dict(rows)
    for kind, name in topics.NAMES.items():
        assert types[name] == kind.__name__
    assert {topics.POSITION, topics.CODEBOOK, topics.DIAGNOSTICS, topics.MARKERS} <= types.keys()
    paths = (name.format(user='<n>') for name in (topics.PATH, topics.TRUE_PATH))
    assert f'| {", ".join(f"`{path}`" for path in paths)} | `nav_msgs/Path` |' in README


def test_example_of_the_library_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    (code,) = re.findall(r'```python\n(.*?)```', README, re.DOTALL)
    # The optimiser's steps are tested elsewhere; a few show that the line is right.
    variables: dict = {}
    exec(code.replace('max_steps=50', 'max_steps=2'), variables)
    assert len(capsys.readouterr().out.splitlines()) >= 3
    assert isinstance(variables['better'], Codebook)
    assert np.isfinite(variables['fix'].mean).all()
