"""requirements.txt and its groups are complete, and agree on the version of each library."""

import collections
import re
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
GROUPS = {path.stem.removeprefix('requirements').lstrip('-'): path
          for path in ROOT.glob('requirements*.txt') if path.stem != 'requirements-noble'}
# What colcon-core requires, for `colcon test` alone.
UNUSED = {'pytest', 'pytest-cov', 'pytest-repeat', 'pytest-rerunfailures'}


def applying(lines):
    """Versions by name of the libraries that this Python needs, from requirements."""
    found = [Requirement(line) for line in lines if line and not line.startswith('#')]
    return {re.sub(r'[-_.]+', '-', one.name).lower(): str(one.specifier) for one in found
            if one.marker is None or one.marker.evaluate({'extra': ''})}


def pins(group):
    return applying(GROUPS[group].read_text(encoding='utf-8').splitlines())


# The groups, with those that they build on.
@pytest.mark.parametrize(('group', 'others'), [
    ('', ()), ('recording', ()), ('samples', ()), ('experiments', ()), ('docs', ()),
    ('test', ('recording',))])
def test_a_group_contains_what_its_libraries_require(group, others):
    present = UNUSED.union(*(pins(one) for one in ('', group, *others)))
    try:
        required = {name: applying(metadata.requires(name) or ()).keys() for name in pins(group)}
    except metadata.PackageNotFoundError as error:
        pytest.skip(f'{error.name} is not installed')
    assert not {name: names - present for name, names in required.items() if names - present}


def test_groups_add_to_requirements_txt_and_agree():
    versions = collections.defaultdict(set)
    for group in GROUPS:
        assert not group or not pins(group).keys() & pins('').keys()
        for name, version in pins(group).items():
            assert version.startswith('==')
            versions[name].add(version)
    assert not {name: found for name, found in versions.items() if len(found) > 1}
