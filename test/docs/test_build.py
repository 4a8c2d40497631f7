"""The documentation builds without a warning and displays without a network."""

import re
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='the pages of the interfaces need ROS')

from rhs_isac_ros.ros import topics  # noqa: E402

ROOT = Path(__file__).parents[2]
DOCS = ROOT / 'docs'


def test_pages_load_nothing_from_other_sites(site):
    for path in site.rglob('*.html'):
        text = path.read_text(encoding='utf-8')
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\ssrc="([^"]*)"', text)
        loaded += re.findall(r'<link[^>]*\shref="([^"]*)"', text)
        assert not [source for source in loaded if '//' in source], path
    for path in site.rglob('*.css'):
        assert not re.search(r'url\(["\']?https?:', path.read_text(encoding='utf-8')), path


def test_interfaces_name_every_topic():
    text = (DOCS / 'interfaces.rst').read_text(encoding='utf-8')
    assert not [name for name in {*topics.NAMES.values(), topics.POSITION, topics.CODEBOOK,
                                  topics.DIAGNOSTICS, topics.MARKERS}
                if not re.search(rf'(?<![\w/]){re.escape(name)}(?![\w/])', text)]


def test_the_installation_page_lists_every_extra():
    import test_installation
    source = (DOCS / 'installing.rst').read_text(encoding='utf-8')
    rows = dict(re.findall(r'^   \* - ``(\w+)``\n     - (.*)$', source, re.MULTILINE))
    extras = test_installation.read_extras()
    assert rows.keys() == extras.keys()
    for name, libraries in extras.items():
        assert rows[name] in (', '.join(libraries), 'all of the above')


@pytest.mark.parametrize(
    'path', [*DOCS.glob('*.rst'), *DOCS.glob('notebooks/*.md')], ids=lambda path: path.stem)
def test_commands_on_the_pages_exist(path):
    text = path.read_text(encoding='utf-8')
    for command, is_folder in re.findall(r'scripts/([a-z.]+[a-z])(?![a-z.])(/?)', text):
        place = ROOT / 'scripts' / command
        assert place.is_dir() if is_folder else place.is_file(), command
    for module in re.findall(r'python3? -m (rhs_isac_ros[\w.]*)', text):
        place = ROOT.joinpath(*module.split('.'))
        assert place.with_suffix('.py').is_file() or (place / '__main__.py').is_file(), module
    for executable in re.findall(r'(?:scripts/run|ros2 run rhs_isac_ros) (\w+)', text):
        folders = [ROOT / 'rhs_isac_ros' / folder for folder in ('nodes', 'tools')]
        assert any((folder / f'{executable}.py').is_file() for folder in folders), executable
    for kind, benchmark in re.findall(r'scripts/(benchmark|reproduce) (\w+)', text):
        folder = {'benchmark': 'benchmarks', 'reproduce': 'figures'}[kind]
        assert (ROOT / 'scripts' / folder / f'{benchmark}.py').is_file(), benchmark
