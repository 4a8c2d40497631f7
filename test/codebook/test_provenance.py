"""Provenance: text that can be parsed, also as the parameter ``codebook.provenance``."""

import dataclasses

import numpy as np
import pytest
import yaml

import rhs_isac_ros
from rhs_isac_ros.codebook import Progress, Provenance
from rhs_isac_ros.codebook.codebook import decode, encode, from_parameter, to_parameter
from rhs_isac_ros.model import Scenario

PLAIN = Provenance(
    method='lbfgs', objective='crlb', seed=3, sampling='sobol', positions=64, scenario={})
END = Progress(step=5, evaluations=9, value_m2=0.1 + 0.2, elapsed_s=1.5)


def text_of(provenance=PLAIN, end=END, reason='done', **changes):
    return dataclasses.replace(
        provenance, steps=end.step, evaluations=end.evaluations, value_m2=float(end.value_m2),
        reason=reason, **changes).to_text()


def test_the_text_is_one_line_with_all_fields():
    assert text_of(scenario={'n_feeds': 2}) == (
        'method=lbfgs, objective=crlb, seed=3, sampling=sobol, positions=64, '
        f'scenario={{"n_feeds":2}}, version="{rhs_isac_ros.__version__}", steps=5, '
        'evaluations=9, value_m2=0.30000000000000004, reason=done')


SCENARIOS = [
    Scenario(),
    Scenario(center_frequencies_hz=(28e9, 29.5e9, 1 / 3 * 1e11), n_feeds=2, delay_spread_s=1e-300,
             feed_positions_m=((0, -0.1, 1e-7), (0, 0.1, 0))),
    Scenario(roi_center_m=(14, 0.1 + 0.2, -1), elements_per_side=3, max_power_w=1e-15),
]


@pytest.mark.parametrize('scenario', SCENARIOS, ids=['table1', 'feeds', 'roi'])
def test_parsing_restores_all_fields(scenario):
    text = text_of(scenario=scenario.changes(), seed=2**31 - 1)
    read = Provenance.parse(text)
    assert read == dataclasses.replace(
        PLAIN, scenario=scenario.changes(), seed=2**31 - 1, steps=5, evaluations=9,
        value_m2=0.1 + 0.2, reason='done')
    assert Scenario(**read.scenario) == scenario


@pytest.mark.parametrize('value', [0.0, 1e-300, 1e22, np.float64(0.25), 3.0, np.inf])
def test_any_value_is_preserved_as_a_float(value):
    end = dataclasses.replace(END, value_m2=value)
    read = Provenance.parse(text_of(end=end)).value_m2
    assert type(read) is float
    assert read == value


@pytest.mark.parametrize('text', [
    '', ' ', 'random', 'method lbfgs, seed 0, 1200 positions', 'null', '3', '[]', '[1, 2]', '{}',
    'a: [', '{method: lbfgs}', '{1: 2}', 'method: lbfgs', '- method', '\x00', '@', '"',
    '{a: !x 1}',
    text_of().replace('seed', 'seeds'), text_of()[1:], text_of() + ', ', text_of() + ', more=1',
    text_of().replace('seed=3', 'seed={')])
def test_parsing_any_other_text_returns_none(text):
    assert Provenance.parse(text) is None


WORDS = ['done', 'max_steps reached', 'null', 'true', 'NaN', '0.1.0', '1e3', '', ' ends ',
         'a, b=c', 'a: b, {c} [d] #e', '"quoted" and \'quoted\'', 'é ∞', 'line\nline', '\x07',
         '%s & *x !tag']


@pytest.mark.parametrize('value', [
    *WORDS, 0, -3, 1e-300, True, None, [], {}, {'n_feeds': 2, 'name': 'a b'}, [1.5, 'x']])
def test_any_value_survives_and_the_text_is_a_string_in_yaml(value):
    encoded = encode({'first': value, 'second': value})
    assert yaml.safe_load(encoded) == encoded
    assert decode(encoded) == {'first': value, 'second': value}


@pytest.mark.parametrize('given', ['seed', 'seed=', '=1', 'a=1,b=2', '[1, 2]', '', 'a=1, b'])
def test_other_texts_are_rejected(given):
    with pytest.raises(ValueError, match=r'expected name=value|Expecting|Extra'):
        decode(given)


@pytest.mark.parametrize('given', [
    *WORDS, 'by hand', 'by hand: 3', '3', '- x', '[1, 2', '"', '@x', 'note="x"', 'note=x',
    '{broken', '2023-99-99', '[' * 700])
def test_any_text_survives_as_a_parameter_that_yaml_parses_as_a_string(given):
    parameter = to_parameter(given)
    assert parameter == '' or yaml.safe_load(parameter) == parameter
    assert from_parameter(parameter) == given


def test_plain_text_is_its_own_parameter():
    assert to_parameter('by hand') == 'by hand'
    assert to_parameter('method=lbfgs, seed=0') == 'method=lbfgs, seed=0'


def test_the_yaml_of_earlier_versions_is_converted():
    legacy = '{method: lbfgs, scenario: {n_feeds: 2}, reason: max_steps reached}'
    assert from_parameter(legacy) == (
        'method=lbfgs, scenario={"n_feeds":2}, reason=max_steps reached')
