"""The documentation builds without a warning, and displays without a network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('sphinx', reason='there is no Sphinx here')
pytest.importorskip('rclpy', reason='pages of the interfaces need ROS')

from rhs_isac_ros.protocol import diagram  # noqa: E402
from rhs_isac_ros.ros import parameters, topics  # noqa: E402

ROOT = Path(__file__).parents[2]
PAGES = ('index', 'tutorial', 'model', 'protocol', 'interfaces', 'extending', 'installing')


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Folder of the pages; as scripts/docs builds them."""
    folder = tmp_path_factory.mktemp('docs')
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-E', '-q', '-b', 'html',
         '-d', folder / 'doctrees', ROOT / 'docs', folder / 'html'],
        capture_output=True, text=True, timeout=240, check=False,
        # A proxy that nobody is: what reads from the network fails.
        env={**os.environ, 'http_proxy': 'http://127.0.0.1:9', 'https_proxy': 'http://127.0.0.1:9',
             'OPENBLAS_NUM_THREADS': '1'})
    assert done.returncode == 0, done.stderr
    assert done.stderr == ''
    return folder / 'html'


def page(site, name):
    return (site / f'{name}.html').read_text(encoding='utf-8')


def test_nothing_comes_from_elsewhere(site):
    for path in site.rglob('*.html'):
        text = path.read_text(encoding='utf-8')
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\ssrc="([^"]*)"', text)
        loaded += re.findall(r'<link[^>]*\shref="([^"]*)"', text)
        assert not [source for source in loaded if '//' in source], path
    for path in site.rglob('*.css'):
        assert not re.search(r'url\(["\']?https?:', path.read_text(encoding='utf-8')), path


def test_formulas_are_mathml(site):
    text = page(site, 'model')
    assert text.count('display="block"') >= 21
    assert '\\frac' not in text


def test_diagrams_are_those_of_the_tables(site):
    text = page(site, 'protocol')
    for role in diagram.ROLES:
        assert diagram.svg(role) in text
    assert '<title>One cycle</title>' in text
    assert 'protocol_state served' in text


def test_interfaces_name_every_topic_and_parameter(site):
    text = re.sub(r'<[^>]+>', '', page(site, 'interfaces'))
    names = {*topics.NAMES.values(), topics.POSITION, topics.CODEBOOK, topics.DIAGNOSTICS,
             topics.MARKERS}
    names |= {parameter.name for group in parameters.NODES.values() for parameter in group}
    for name in names:
        assert re.search(rf'(?<![\w/]){re.escape(name)}(?![\w/])', text), name
    for message in (ROOT / 'msg_defs' / 'msg').glob('*.msg'):
        for line in message.read_text(encoding='utf-8').splitlines()[3:]:
            assert re.sub(r'\s+', ' ', line.split('#')[0]).strip() in re.sub(r'\s+', ' ', text)


@pytest.mark.parametrize('name', PAGES)
def test_commands_on_the_pages_are_there(name):
    text = (ROOT / 'docs' / f'{name}.rst').read_text(encoding='utf-8')
    for command in re.findall(r'scripts/([a-z.]+[a-z])', text):
        assert (ROOT / 'scripts' / command).is_file(), command
    for module in re.findall(r'python -m (rhs_isac_ros[\w.]*)', text):
        place = ROOT.joinpath(*module.split('.'))
        assert place.with_suffix('.py').is_file() or (place / '__main__.py').is_file(), module
    for executable in re.findall(r'scripts/run (\w+)', text):
        assert (ROOT / 'rhs_isac_ros' / 'nodes' / f'{executable}.py').is_file(), executable
