"""Provenance: text that can be parsed, and the checks before resuming."""

import dataclasses

import numpy as np
import pytest

import rhs_isac_ros
from rhs_isac_ros.codebook import Codebook, Progress, Provenance
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


@pytest.mark.parametrize('reason', [
    '', 'a: b, {c} [d] #e', '"quoted" and \'quoted\'', 'é ∞ 日本', '- x', 'null', '1e3', 'yes',
    '2023-99-99', '%s & *x !tag', '\\n \t|>', 'line\nline', 'x' * 3000, '\x07', ' ends '])
def test_any_reason_is_preserved(reason):
    assert Provenance.parse(text_of(reason=reason)).reason == reason


@pytest.mark.parametrize('value', [0.0, 1e-300, 1e22, np.float64(0.25), 3.0, np.inf])
def test_any_value_is_preserved_as_a_float(value):
    end = dataclasses.replace(END, value_m2=value)
    read = Provenance.parse(text_of(end=end)).value_m2
    assert type(read) is float
    assert read == value


def test_a_codebook_file_preserves_it(small, tmp_path):
    text = text_of(scenario=small.scenario.changes(), reason='a: "b"')
    dataclasses.replace(small.codebook, provenance=text).save(tmp_path / 'codebook.yaml')
    loaded = Codebook.load(tmp_path / 'codebook.yaml')
    assert loaded.provenance == text
    assert Provenance.parse(loaded.provenance).scenario == small.scenario.changes()


@pytest.mark.parametrize('text', [
    '', ' ', 'random', 'method lbfgs, seed 0, 1200 positions', 'null', '3', '[]', '[1, 2]', '{}',
    'a: [', '{method: lbfgs}', '{1: 2}', 'method: lbfgs', '- method', '\x00', '@', '"',
    '{a: !x 1}',
    text_of().replace('seed', 'seeds'), text_of()[1:], text_of() + ', ', text_of() + ', more=1',
    text_of().replace('seed=3', 'seed={')])
def test_parsing_any_other_text_returns_none(text):
    assert Provenance.parse(text) is None


def test_resuming_returns_the_earlier_progress(small):
    earlier = PLAIN.resumed(text_of())
    assert (earlier.steps, earlier.evaluations, earlier.reason) == (5, 9, 'done')
