"""The documentation builds without a warning and displays without a network."""

import dataclasses
import re
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='the pages of the interfaces need ROS')

import states  # noqa: E402

from rhs_isac_ros.model import Scenario  # noqa: E402
from rhs_isac_ros.ros import parameters, topics  # noqa: E402

ROOT = Path(__file__).parents[2]
DOCS = ROOT / 'docs'
NOTEBOOKS = sorted(path.stem for path in (DOCS / 'notebooks').glob('*.md'))


def page(site, name):
    return (site / f'{name}.html').read_text(encoding='utf-8')


def text_of(site, name):
    return re.sub(r'<[^>]+>', '', page(site, name))


def contains(text, name):
    return re.search(rf'(?<![\w/]){re.escape(name)}(?![\w/])', text)


def test_pages_load_nothing_from_other_sites(site):
    for path in site.rglob('*.html'):
        text = path.read_text(encoding='utf-8')
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\ssrc="([^"]*)"', text)
        loaded += re.findall(r'<link[^>]*\shref="([^"]*)"', text)
        assert not [source for source in loaded if '//' in source], path
    for path in site.rglob('*.css'):
        assert not re.search(r'url\(["\']?https?:', path.read_text(encoding='utf-8')), path


@pytest.mark.parametrize(('name', 'words'), [
    ('model', 'region of interest'), ('band_plans', 'Range ambiguity'),
    ('own_hall', 'Virtual sources'), ('site', 'Candidate positions')])
def test_pictures_are_drawn_with_a_description(site, name, words):
    (picture,) = re.findall(r'<img alt="([^"]+)" class="plot-directive"[^>]*src="(_images/[^"]+)"',
                            page(site, name))
    assert words in picture[0]
    assert (site / picture[1]).stat().st_size > 5000


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_notebooks_are_pages_with_their_outputs(site, outputs, name):
    text = page(site, f'notebooks/{name}')
    pictures = re.findall(r'<img alt="([^"]+)" src="\.\./(_images/[^"]+)"', text)
    assert len(pictures) == len(outputs(name, 'display_data'))
    assert all(len(alt) > 20 and (site / file).is_file() for alt, file in pictures)
    assert text.count('class="output stream') == len(outputs(name, 'stream'))
    (executed,) = re.findall(r'href="\.\./(_downloads/[^"]+\.ipynb)"', text)
    assert (site / executed).is_file()


def test_diagrams_are_drawn_from_the_transition_tables(site):
    text = page(site, 'protocol')
    for role in states.ROLES:
        assert states.picture(role) in text
    assert '<title>One cycle</title>' in text
    assert 'protocol_state served' in text


def test_interfaces_name_every_topic_and_message_field(site):
    text = text_of(site, 'interfaces')
    for name in {*topics.NAMES.values(), topics.POSITION, topics.CODEBOOK, topics.DIAGNOSTICS,
                 topics.MARKERS}:
        assert contains(text, name), name
    for message in (ROOT / 'msg_defs' / 'msg').glob('*.msg'):
        for line in message.read_text(encoding='utf-8').splitlines()[3:]:
            assert re.sub(r'\s+', ' ', line.split('#')[0]).strip() in re.sub(r'\s+', ' ', text)


def test_parameters_name_every_parameter(site):
    text = text_of(site, 'parameters')
    for group in parameters.NODES.values():
        for parameter in group:
            assert contains(text, parameter.name), parameter.name


def test_scenarios_name_every_field(site):
    text = text_of(site, 'scenario')
    for field in dataclasses.fields(Scenario):
        assert contains(text, field.name), field.name


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
    for command in re.findall(r'scripts/([a-z.]+[a-z])', text):
        assert (ROOT / 'scripts' / command).is_file(), command
    for module in re.findall(r'python3? -m (rhs_isac_ros[\w.]*)', text):
        place = ROOT.joinpath(*module.split('.'))
        assert place.with_suffix('.py').is_file() or (place / '__main__.py').is_file(), module
    for executable in re.findall(r'(?:scripts/run|ros2 run rhs_isac_ros) (\w+)', text):
        folders = [ROOT / 'rhs_isac_ros' / folder for folder in ('nodes', 'tools')]
        assert any((folder / f'{executable}.py').is_file() for folder in folders), executable
    for kind, benchmark in re.findall(r'scripts/(benchmark|reproduce) (\w+)', text):
        folder = {'benchmark': 'benchmarks', 'reproduce': 'figures'}[kind]
        assert (ROOT / 'scripts' / folder / f'{benchmark}.py').is_file(), benchmark
