"""The documentation builds without a warning and displays without a network."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

for library in ('sphinx', 'furo', 'myst_parser', 'matplotlib'):
    pytest.importorskip(library, reason=f'{library} is not installed')
pytest.importorskip('rclpy', reason='the pages of the interfaces need ROS')

import diagram  # noqa: E402

from rhs_isac_ros.model import Scenario  # noqa: E402
from rhs_isac_ros.ros import parameters, topics  # noqa: E402

ROOT = Path(__file__).parents[2]
DOCS = ROOT / 'docs'
PAGES = sorted(path.stem for path in DOCS.glob('*.rst'))
NOTEBOOKS = sorted(path.stem for path in (DOCS / 'notebooks').glob('*.md'))


@pytest.fixture(scope='module')
def site(tmp_path_factory, notebooks):
    """Folder of the pages, built as scripts/docs builds them."""
    folder = tmp_path_factory.mktemp('docs')
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-E', '-q', '-b', 'html',
         '-D', f'notebook_folder={notebooks[1]}', '-d', folder / 'doctrees', DOCS,
         folder / 'html'],
        capture_output=True, text=True, timeout=240, check=False,
        # A proxy that does not exist: reading from the network fails.
        env={**os.environ, 'http_proxy': 'http://127.0.0.1:9', 'https_proxy': 'http://127.0.0.1:9',
             'OPENBLAS_NUM_THREADS': '1'})
    assert done.returncode == 0, done.stderr
    assert done.stderr == ''
    return folder / 'html'


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


def test_pages_have_a_dark_mode_and_a_search(site):
    text = page(site, 'index')
    assert 'class="theme-toggle' in text
    assert 'role="search"' in text
    assert 'What this does not model' in (site / 'searchindex.js').read_text(encoding='utf-8')


@pytest.mark.parametrize(('name', 'words'), [
    ('model', 'region of interest'), ('band_plans', 'Range ambiguity'),
    ('own_hall', 'Virtual sources')])
def test_pictures_are_drawn_with_a_description(site, name, words):
    (picture,) = re.findall(r'<img alt="([^"]+)" class="drawn"[^>]*src="(_images/[^"]+)"',
                            page(site, name))
    assert words in picture[0]
    assert (site / picture[1]).stat().st_size > 5000


def test_diagrams_and_their_style_have_the_colour_of_the_text(site):
    for picture in re.findall(r'<svg[^>]*class="(?:states|sequence)".*?</svg>',
                              page(site, 'protocol'), re.DOTALL):
        (name,) = re.findall(r'^<svg[^>]*class="(\w+)"', picture)
        (style,) = re.findall(r'<style>(.*)</style>', picture)
        colors = re.findall(r'(?:fill|stroke):([^;}]+)', style)
        assert set(colors) <= {'currentColor', 'none', 'var(--color-background-primary,white)'}
        # The page contains other pictures, which a style without a class would change.
        assert all(rule.startswith(f'.{name} ') for rule in re.findall(
            r'([^{},]+)(?=[^{}]*\{)', style))


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_notebooks_are_pages_with_their_outputs(site, notebooks, name):
    text = page(site, f'notebooks/{name}')
    cells = json.loads((site / 'notebooks' / f'{name}.ipynb').read_text(encoding='utf-8'))['cells']
    outputs = [output for cell in cells for output in cell.get('outputs', ())]
    pictures = re.findall(r'<img alt="([^"]+)"[^>]*src="\.\./(_images/[^"]+)"', text)
    assert [alt for alt, _ in pictures] == [
        output['metadata']['image/png']['alt'] for output in outputs
        if output['output_type'] == 'display_data']
    assert all((site / file).is_file() for _, file in pictures)
    assert text.count('cell-output highlight') == sum(
        output['output_type'] == 'stream' for output in outputs)
    assert f'href="{name}.ipynb"' in text


def test_formulas_are_mathml(site):
    text = page(site, 'model')
    assert text.count('display="block"') >= 21
    assert '\\frac' not in text


def test_diagrams_are_drawn_from_the_transition_tables(site):
    text = page(site, 'protocol')
    for role in diagram.ROLES:
        assert diagram.svg(role) in text
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


def test_the_table_of_topics_has_every_topic_with_its_type():
    source = (DOCS / 'interfaces.rst').read_text(encoding='utf-8')
    types = dict(re.findall(r'^   "``([\w/<>]+)``", "``([\w/]+)``"', source, re.MULTILINE))
    assert {topics.NAMES[kind]: kind.__name__ for kind in topics.NAMES}.items() <= types.items()
    assert {topics.POSITION, topics.CODEBOOK, topics.DIAGNOSTICS, topics.MARKERS} <= types.keys()
    for name in (topics.PATH, topics.TRUE_PATH):
        assert types[name.format(user='<n>')] == 'nav_msgs/Path'


def test_parameters_name_every_parameter(site):
    text = text_of(site, 'parameters')
    for group in parameters.NODES.values():
        for parameter in group:
            assert contains(text, parameter.name), parameter.name


def test_scenarios_name_every_field(site):
    text = text_of(site, 'scenario')
    for field in dataclasses.fields(Scenario):
        assert contains(text, field.name), field.name


def test_diagnostics_have_every_kind_of_key(site):
    text = text_of(site, 'interfaces')
    for kind in ('parameter', 'pending', 'failed', 'cycles', 'retries', 'dropped', 'beacons',
                 'received', 'sent'):
        assert f'{kind}.&lt;' in text, kind


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


@pytest.mark.parametrize('name', [*PAGES, *(f'notebooks/{name}' for name in NOTEBOOKS)])
def test_every_page_is_in_the_table_of_contents(name):
    index = (DOCS / 'index.rst').read_text(encoding='utf-8')
    assert name == 'index' or re.search(rf'^   {name}$', index, re.MULTILINE)
