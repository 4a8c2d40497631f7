"""The text of the parameter ``codebook.provenance``."""

import pytest
import yaml

from rhs_isac_ros.codebook import codebook as text

WORDS = ['done', 'max_steps reached', 'null', 'true', 'NaN', '0.1.0', '1e3', '', ' ends ',
         'a, b=c', 'a: b, {c} [d] #e', '"quoted" and \'quoted\'', 'é ∞', 'line\nline', '\x07',
         '%s & *x !tag']


@pytest.mark.parametrize('value', [
    *WORDS, 0, -3, 1e-300, True, None, [], {}, {'n_feeds': 2, 'name': 'a b'}, [1.5, 'x']])
def test_any_value_survives_and_the_text_is_a_string_in_yaml(value):
    encoded = text.encode({'first': value, 'second': value})
    assert yaml.safe_load(encoded) == encoded
    assert text.decode(encoded) == {'first': value, 'second': value}


@pytest.mark.parametrize('given', ['seed', 'seed=', '=1', 'a=1,b=2', '[1, 2]', '', 'a=1, b'])
def test_other_texts_are_rejected(given):
    with pytest.raises(ValueError, match=r'expected name=value|Expecting|Extra'):
        text.decode(given)


@pytest.mark.parametrize('given', [
    *WORDS, 'by hand', 'by hand: 3', '3', '- x', '[1, 2', '"', '@x', 'note="x"', 'note=x',
    '{broken', '2023-99-99', '[' * 3000])
def test_any_text_survives_as_a_parameter_that_yaml_parses_as_a_string(given):
    parameter = text.to_parameter(given)
    assert parameter == '' or yaml.safe_load(parameter) == parameter
    assert text.from_parameter(parameter) == given


def test_plain_text_is_its_own_parameter():
    assert text.to_parameter('by hand') == 'by hand'
    assert text.to_parameter('method=lbfgs, seed=0') == 'method=lbfgs, seed=0'


def test_the_yaml_of_earlier_versions_is_converted():
    legacy = '{method: lbfgs, scenario: {n_feeds: 2}, reason: max_steps reached}'
    assert text.from_parameter(legacy) == (
        'method=lbfgs, scenario={"n_feeds":2}, reason=max_steps reached')
