"""The example of the README runs, and its links and commands lead somewhere."""

import re
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook

ROOT = Path(__file__).parents[1]
README = (ROOT / 'README.md').read_text(encoding='utf-8')


def test_the_library_example_runs(monkeypatch, capsys, tmp_path):
    # Not in the clone: the example must not depend on the working directory.
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r'```python\n(.*?)```', README, re.DOTALL)
    # Other tests cover the optimiser; two steps show that the call is right.
    variables: dict = {}
    exec(code.replace('max_steps=50', 'max_steps=2'), variables)
    assert len(capsys.readouterr().out.splitlines()) >= 3
    assert isinstance(variables['better'], Codebook)
    assert np.isfinite(variables['fix'].mean).all()


@pytest.mark.parametrize('page', ['README.md', 'QUALITY_DECLARATION.md'])
def test_links_and_commands_lead_to_files(page):
    text = (ROOT / page).read_text(encoding='utf-8')
    targets = re.findall(r'\]\(([^)#:]+)[^):]*\)', text)
    targets += re.findall(r'scripts/[a-z.]+[a-z]', text)
    assert len(targets) > 10
    assert not [target for target in targets if not (ROOT / target).exists()]
