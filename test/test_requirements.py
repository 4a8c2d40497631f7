"""requirements.txt and its groups are complete, and agree on the version of each library."""

import re
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
FILES = {path.stem.removeprefix('requirements').lstrip('-'): path
         for path in ROOT.glob('requirements*.txt') if path.stem != 'requirements-noble'}
# What colcon-core requires, for `colcon test` alone.
UNUSED = {'pytest', 'pytest-cov', 'pytest-repeat', 'pytest-rerunfailures'}


def canonical(name):
    return re.sub(r'[-_.]+', '-', name).lower()


def pins(group):
    """Requirements of a file that apply to this Python, by canonical name."""
    lines = FILES[group].read_text(encoding='utf-8').splitlines()
    found = [Requirement(line) for line in lines if line and not line.startswith('#')]
    return {canonical(pin.name): pin for pin in found
            if pin.marker is None or pin.marker.evaluate()}


def requirements_of(name):
    """Requirements of an installed library that apply to this Python, without extras."""
    for text in metadata.requires(name) or ():
        required = Requirement(text)
        if required.marker is None or required.marker.evaluate({'extra': ''}):
            yield canonical(required.name)


# The groups, with those that they build on.
@pytest.mark.parametrize(('group', 'others'), [
    ('', ()), ('recording', ()), ('experiments', ()), ('docs', ()), ('test', ('recording',))])
def test_a_group_contains_what_its_libraries_require(group, others):
    present = {name for one in ('', group, *others) for name in pins(one)}
    missing = {}
    for name in pins(group):
        try:
            missing[name] = set(requirements_of(name)) - present - UNUSED
        except metadata.PackageNotFoundError:
            pytest.skip(f'{name} is not installed')
    assert not {name: lacks for name, lacks in missing.items() if lacks}


def test_groups_add_to_requirements_txt():
    """Pip installs both at the same time."""
    assert not {group for group in FILES if group and pins(group).keys() & pins('').keys()}


def test_all_groups_agree():
    versions = {}
    for group in FILES:
        for name, pin in pins(group).items():
            assert str(pin.specifier).startswith('=='), pin
            versions.setdefault(name, set()).add(str(pin.specifier))
    assert not {name: found for name, found in versions.items() if len(found) > 1}
