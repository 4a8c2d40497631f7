"""The container files and the settings of rosdoc2; no image is built here."""

import json
import re
import shlex
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope='module')
def instructions():
    """The instructions of the Dockerfile, as (name, arguments)."""
    text = (ROOT / 'Dockerfile').read_text(encoding='utf-8')
    lines = re.sub(r'^\s*#.*\n', '', text, flags=re.MULTILINE).replace('\\\n', ' ')
    return [tuple(line.split(maxsplit=1)) for line in lines.splitlines() if line.strip()]


def test_the_image_is_the_official_one_of_jazzy(instructions):
    assert instructions[0] == ('FROM', 'ros:jazzy-ros-base')
    assert {name for name, _ in instructions} <= {
        'FROM', 'WORKDIR', 'COPY', 'RUN', 'ENTRYPOINT', 'CMD'}


def test_the_commands_are_those_of_the_page_on_installing(instructions):
    page = (ROOT / 'docs' / 'installing.rst').read_text(encoding='utf-8')
    commands = [shlex.split(part) for name, text in instructions if name == 'RUN'
                for part in text.split('&&')]
    for words in (['ln', '-s', 'rhs_isac_ros/msg_defs'], ['colcon', 'build'],
                  ['rosdep', 'install', '--from-paths', 'src', '--ignore-src']):
        assert ' '.join(words) in page
        assert any(one[:len(words)] == words for one in commands), words
    (pip,) = (one for one in commands if 'pip' in one)
    assert (ROOT / pip[-1].removeprefix('src/rhs_isac_ros/')).is_file()


def test_the_container_starts_a_launch_file_of_the_package(instructions):
    last = dict(instructions[-2:])
    shell, entry = json.loads(last['ENTRYPOINT']), json.loads(last['CMD'])
    assert shell[:2] == ['/bin/sh', '-c'] and '/ws/install/setup.sh' in shell[2]
    assert entry[:3] == ['ros2', 'launch', 'rhs_isac_ros']
    assert (ROOT / 'launch' / entry[3]).is_file()


def test_the_editor_opens_the_clone_in_this_image():
    folder = ROOT / '.devcontainer'
    settings = json.loads((folder / 'devcontainer.json').read_text(encoding='utf-8'))
    assert (folder / settings['build']['dockerfile']).resolve() == ROOT / 'Dockerfile'
    assert (folder / settings['build']['context']).resolve() == ROOT


def test_builds_are_not_copied_into_the_image():
    ignored = (ROOT / '.dockerignore').read_text(encoding='utf-8').split()
    assert {'.git', '.venv*', 'build', 'install', 'log'} <= set(ignored)


def test_rosdoc2_builds_the_pages_of_this_repository():
    export = ElementTree.parse(ROOT / 'package.xml').getroot().find('export/rosdoc2')
    head, body = yaml.safe_load_all((ROOT / export.text).read_text(encoding='utf-8'))
    assert head == {'type': 'rosdoc2 config', 'version': 1}
    (builder,) = body['builders']
    assert (ROOT / builder['sphinx']['sphinx_sourcedir'] / 'conf.py').is_file()


def test_both_packages_name_the_same_places():
    urls = [{url.get('type'): url.text for url in ElementTree.parse(file).getroot().iter('url')}
            for file in (ROOT / 'package.xml', ROOT / 'msg_defs' / 'package.xml')]
    assert urls[0] == urls[1] and urls[0].keys() == {'website', 'repository', 'bugtracker'}
    assert urls[0]['bugtracker'].startswith(urls[0]['repository'])
