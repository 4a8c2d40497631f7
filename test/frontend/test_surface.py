"""The contract of every surface, and their selection by name."""

import numpy as np
import pytest
from faulty_board import ANSWER_S, FaultyBoard

from rhs_isac_ros.frontend import SURFACES, Surface, make_surface
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.arguments import parse_options

PLUGIN = """
class Twelve:
    n_elements = 12
    waits = False
    def __init__(self, n_elements, row=1): pass
    def apply(self, configuration): pass
    def close(self): pass
def nothing(n_elements): pass
"""


@pytest.fixture(params=SURFACES)
def contract(request):
    """A surface, and a function that returns what its elements show."""
    if request.param == 'emulated':
        surface = make_surface('emulated', 12)
        yield surface, lambda: surface.applied
    else:
        with FaultyBoard() as board:
            surface = make_surface(request.param, 256, port=board.port, timeout_s=ANSWER_S)
            yield surface, lambda: board.configuration
            surface.close()


def test_a_surface_shows_what_was_applied_last(contract):
    surface, shown = contract
    assert isinstance(surface, Surface)
    rng = np.random.default_rng(0)
    for _ in range(20):
        configuration = rng.integers(0, 2, surface.n_elements)
        surface.apply(configuration)
        assert (shown() == configuration).all()


def test_a_configuration_is_copied(contract):
    surface, shown = contract
    configuration = [1] + [0] * (surface.n_elements - 1)
    surface.apply(configuration)
    configuration[0] = 0
    assert shown()[0] == 1


@pytest.mark.parametrize(('change', 'expected'), [
    (lambda values: values[1:], r'^configuration: shape \(\d+,\), expected \[\d+\]$'),
    (lambda values: values[None], r'^configuration: shape \(1, \d+\), expected \[\d+\]$'),
    (lambda values: values * 1j, '^configuration: complex numbers'),
    (lambda values: values * np.nan, '^configuration: not finite'),
    (lambda values: values + 1.5 * (np.arange(values.size) == 3),
     r'^configuration\[3\]: 2.5, expected 0 (or|to) 1$'),
    (lambda values: -values, r'^configuration\[0\]: -1, expected 0 (or|to) 1$'),
    (lambda values: np.ma.masked_array(values, values > 0), '^configuration: a masked array')])
def test_an_invalid_configuration_changes_nothing(contract, change, expected):
    surface, shown = contract
    before = np.arange(surface.n_elements) % 2
    surface.apply(before)
    with pytest.raises(ValueError, match=expected):
        surface.apply(change(np.ones(surface.n_elements)))
    assert (shown() == before).all()


def test_a_closed_surface_opens_again(contract):
    surface, shown = contract
    surface.close()
    surface.apply(np.zeros(surface.n_elements))
    surface.close()
    surface.close()
    surface.apply(np.ones(surface.n_elements))
    assert shown().all()


@pytest.fixture
def plugin(install):
    install('twelve', PLUGIN, {plugins.SURFACES: {'twelve': 'Twelve', 'not': 'nothing'}})


def test_a_plugin_is_a_surface(plugin):
    assert make_surface('twelve', 12, row=3).n_elements == 12


@pytest.mark.parametrize(('arguments', 'options', 'expected'), [
    (('x', 12), {}, r"'x', expected one of \['emulated', .*'twelve'\]"),
    (('not', 12), {}, 'returned None, expected an object with apply, close, n_elem'),
    (('twelve', 13), {}, 'twelve: 12 elements, expected 13'),
    (('twelve', 12), {'color': 1}, "entry point .*unexpected keyword argument 'color'"),
    (('opensourceris', 12), {'port': 'x'}, 'n_elements: 12, expected 256'),
    (('opensourceris', 256), {}, "opensourceris: missing a required .*'port'"),
    (('emulated', 12), {'port': 'x'}, "emulated: got an unexpected .*'port'")])
def test_a_surface_that_cannot_be_created_names_the_reason(plugin, arguments, options, expected):
    with pytest.raises(ValueError, match=expected):
        make_surface(*arguments, **options)


@pytest.mark.parametrize(('text', 'options'), [
    ('', {}),
    ('port=/dev/ttyUSB0 read_back=false timeout_s=0.5 tile=2',
     {'port': '/dev/ttyUSB0', 'read_back': False, 'timeout_s': 0.5, 'tile': 2}),
    ('port="/dev/my board" address=10.0.0.1',
     {'port': '/dev/my board', 'address': '10.0.0.1'})])
def test_options_are_written_as_words(text, options):
    assert parse_options(text) == options


@pytest.mark.parametrize('text', ['port', '=x', 'my-port=x', 'a=1 a=2', 'a="x', 'a=[1'])
def test_other_texts_are_no_options(text):
    with pytest.raises(ValueError, match=r'expected NAME=VALUE|No closing|while parsing'):
        parse_options(text)
