"""The codebook: checks, id, parameters and files; and the shipped codebooks."""

import copy
import dataclasses
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from rhs_isac_ros.bounds import PairwiseErrorCost, crlb
from rhs_isac_ros.codebook import Codebook, CodebookError, Provenance, directional_codebook
from rhs_isac_ros.codebook.objective import draw_confusable
from rhs_isac_ros.model import Scenario

CONFIG = Path(__file__).parents[2] / 'config'


@pytest.mark.parametrize('copied', [
    copy.copy, copy.deepcopy, lambda codebook: pickle.loads(pickle.dumps(codebook))])
def test_a_copy_is_equal_and_read_only(copied):
    codebook = Codebook(np.zeros((2, 1, 3)), np.ones((2, 1, 1, 1)), 1.0, 'origin')
    known_id, found = codebook.id, copied(codebook)
    assert (found.id, found.average_crlb_m2, found.provenance) == (known_id, 1.0, 'origin')
    for array in (found.analog, found.digital):
        with pytest.raises(ValueError, match='read-only'):
            array[:] = 1


def test_arrays_are_copied_converted_and_read_only():
    analog = np.zeros((2, 1, 3), dtype=int)
    codebook = Codebook(analog, [[[[1]]], [[[2j]]]])
    analog[:] = 1
    assert codebook.shape == (2, 1, 1, 1, 3)
    assert codebook.analog.dtype == np.float64
    assert codebook.digital.dtype == np.complex128
    assert not codebook.analog.any()
    for array in (codebook.analog, codebook.digital):
        with pytest.raises(ValueError, match='read-only'):
            array[:] = 0


GOOD = {'analog': np.full((1, 2, 3), 0.5), 'digital': np.ones((1, 4, 2, 1))}


@pytest.mark.parametrize(('changes', 'words'), [
    ({'analog': np.zeros((2, 3))}, [r'analog: shape (2, 3)', 'expected [N_B, F, N_E]']),
    ({'analog': np.zeros((1, 2, 0))}, ['analog: shape (1, 2, 0)', 'expected sizes from 1']),
    ({'digital': np.ones((1, 2, 1))}, ['digital: shape', 'expected [N_B, N_SB, F, K]']),
    ({'analog': 'x'}, ['analog: ', 'expected numbers [N_B, F, N_E]']),
    ({'analog': [[[0.1], [0.1, 0.2]]]}, ['analog: ', 'expected numbers']),
    ({'analog': None}, ['analog: ', 'expected']),
    ({'analog': [[[0.1, np.nan, 0.2], [0.3, 0.4, 0.5]]]}, ['analog: not finite']),
    ({'digital': [[[[1], [1]]] * 3 + [[[1], [1j * np.nan]]]]}, ['digital: not finite']),
    ({'analog': np.full((1, 2, 3), 1.5)}, ['analog: 1.5 to 1.5', 'expected 0 to 1']),
    ({'analog': np.full((1, 2, 3), -0.1)}, ['analog: -0.1 to -0.1', 'expected 0 to 1']),
    ({'analog': np.full((1, 3, 3), 0.5)}, ['[N_B, F] = (1, 3)', 'expected (1, 2)']),
    ({'analog': np.full((2, 2, 3), 0.5)}, ['[N_B, F] = (2, 2)', 'expected (1, 2)']),
])
def test_malformed_content_is_an_error(changes, words):
    with pytest.raises(CodebookError) as caught:
        Codebook(**(GOOD | changes))
    for word in words:
        assert word in str(caught.value)


def test_the_id_depends_on_the_arrays_only(small):
    codebook = small.codebook
    assert re.fullmatch('cb[0-9a-f]{16}', codebook.id)
    noted = dataclasses.replace(codebook, average_crlb_m2=1.0, provenance='noted')
    assert noted.id == Codebook(codebook.analog.copy(), codebook.digital.copy()).id == codebook.id
    analog, digital = codebook.analog.copy(), codebook.digital.copy()
    analog[0, 1, 2] = np.nextafter(analog[0, 1, 2], 0.5)
    digital[0, 2, 1, 1] += 1e-18j
    swapped = Codebook(codebook.analog[:, ::-1], codebook.digital)
    others = [Codebook(analog, codebook.digital), Codebook(codebook.analog, digital), swapped]
    # The same numbers in another shape make a different codebook.
    flat = np.full(4, 0.5)
    others += [Codebook(np.full((1, 1, 4), 0.5), flat.reshape(1, 1, 1, 4)),
               Codebook(np.full((1, 1, 4), 0.5), flat.reshape(1, 4, 1, 1))]
    assert len({codebook.id, *(other.id for other in others)}) == 6


def test_the_id_is_the_same_in_all_versions():
    """Recordings and files contain ids, so their definition is part of the format."""
    codebook = Codebook(np.full((1, 1, 1), 2958 / 4e5), np.ones((1, 1, 1, 1)))
    assert codebook.id == 'cb756847581339e099'


@pytest.mark.parametrize(('changes', 'words'), [
    ({'n_frames': 1}, 'analog: shape (1, 2, 16), expected [N_B, F, N_E] = (1, 1, 16)'),
    ({'elements_per_side': 5}, 'analog: shape (1, 2, 16), expected [N_B, F, N_E] = (1, 2, 25)'),
    ({'center_frequencies_hz': (2e9, 3e9)}, 'expected [N_B, F, N_E] = (2, 2, 16)'),
    ({'n_feeds': 3}, 'digital: shape (1, 3, 2, 2), expected [N_B, N_SB, F, K] = (1, 3, 2, 3)'),
    ({'n_subbands': 2}, 'digital: shape (1, 3, 2, 2), expected [N_B, N_SB, F, K] = (1, 2, 2, 2)'),
    ({'max_power_w': 2e-3}, 'power 0.001 W, expected max_power_w = 0.002 W'),
])
def test_check_names_the_size_that_differs(small, changes, words):
    with pytest.raises(CodebookError, match=re.escape(words)):
        small.codebook.check(dataclasses.replace(small.scenario, **changes))


@pytest.mark.parametrize(('factor', 'power'), [(1.001, r'0\.001001'), (0.999, r'0\.000999')])
def test_check_finds_one_wrong_frame(small, factor, power):
    digital = small.codebook.digital.copy()
    digital[0, :, 1] *= np.sqrt(factor)
    codebook = Codebook(small.codebook.analog, digital)
    with pytest.raises(CodebookError, match=rf'digital: a frame has power {power} W'):
        codebook.check(small.scenario)
    Codebook(small.codebook.analog, small.codebook.digital * (1 + 1e-8)).check(small.scenario)


def test_a_file_preserves_every_bit(case, tmp_path):
    path = tmp_path / 'codebook.yaml'
    codebook = dataclasses.replace(
        case.codebook, average_crlb_m2=0.1 + 0.2, provenance='by hand: "é"\n')
    codebook.save(path)
    loaded = Codebook.load(path)
    np.testing.assert_array_equal(loaded.analog, codebook.analog)
    np.testing.assert_array_equal(loaded.digital, codebook.digital)
    assert loaded.id == codebook.id
    assert loaded.average_crlb_m2 == codebook.average_crlb_m2
    assert loaded.provenance == codebook.provenance


def test_the_file_is_a_ros_2_parameter_file(tmp_path):
    """A list with integers and floats, such as [1, 2.5], would keep a node from starting."""
    codebook = Codebook(
        [[[0, 1, 0.5]]], [[[[1e-5, 1]]]], average_crlb_m2=2, provenance='x')
    codebook.save(tmp_path / 'codebook.yaml')
    content = yaml.safe_load((tmp_path / 'codebook.yaml').read_text(encoding='utf-8'))
    (node, inside), = content.items()
    assert node.startswith('/**/')
    assert list(inside) == ['ros__parameters']
    values = inside['ros__parameters']['codebook']
    assert values == {
        'id': codebook.id, 'shape': [1, 1, 1, 2, 3], 'average_crlb': 2.0, 'provenance': 'x',
        'analog': [0.0, 1.0, 0.5], 'digital_re': [1e-5, 1.0], 'digital_im': [0.0, 0.0]}
    assert next(iter(values)) == 'id'
    assert all(type(size) is int for size in values['shape'])
    for name in ('analog', 'digital_re', 'digital_im'):
        assert all(type(value) is float for value in values[name])
    assert type(values['average_crlb']) is float


MALFORMED = [
    ('codebook.shape', None, 'codebook.shape'),
    ('codebook.shape', [1, 3, 2, 2], 'codebook.shape: [1, 3, 2, 2], expected [N_B, N_SB, F'),
    ('codebook.shape', [1, 3, 2, 2, 0], 'codebook.shape: [1, 3, 2, 2, 0], expected'),
    ('codebook.shape', [2**20] * 5, 'values, expected 1208925819614629174706176 = '),
    ('codebook.shape', [1, 3, 2, 2, -16], 'codebook.shape: [1, 3, 2, 2, -16], expected'),
    ('codebook.shape', 5, 'codebook.shape'),
    ('codebook.shape', [1, 3, 2, 2, 9], 'codebook.analog: 32 values, expected 18 = 1 x 2 x 9'),
    ('codebook.analog', [], 'codebook.analog: 0 values, expected 32 = 1 x 2 x 16'),
    ('codebook.analog', ['x'] * 32, 'analog'),
    ('codebook.digital_re', [0.0], 'codebook.digital_re: 1 values, expected 12 = 1 x 3 x 2 x 2'),
    ('codebook.digital_im', [0.0] * 13, 'codebook.digital_im: 13 values, expected 12'),
    ('codebook.analog', [2.0] * 32, 'analog: 2 to 2, expected 0 to 1'),
    ('codebook.average_crlb', 'low', 'average_crlb'),
    ('codebook.id', '0123456789abcdef', "codebook.id: '0123456789abcdef', expected "),
]


@pytest.mark.parametrize(('name', 'value', 'words'), MALFORMED)
def test_malformed_parameters_are_errors(small, name, value, words):
    with pytest.raises(CodebookError, match=re.escape(words)):
        Codebook.from_parameters(small.codebook.to_parameters() | {name: value})


@pytest.mark.parametrize('change', [{}, {'codebook.id': ''}], ids=['missing', 'empty'])
def test_the_id_is_optional(small, change):
    parameters = small.codebook.to_parameters()
    del parameters['codebook.id']
    assert Codebook.from_parameters(parameters | change).id == small.codebook.id


@pytest.mark.parametrize(('content', 'words'), [
    (b'', 'expected ros__parameters with a mapping named codebook'),
    (b'a: [1', 'cannot be read'),
    (b'\xff\xfe\x00', 'cannot be read'),
    (b'a: 2023-99-99', 'cannot be read'),
    (b'- 1', 'expected ros__parameters'),
    (b'codebook: 1', 'expected ros__parameters'),
    (b'node: {ros__parameters: 3}', 'expected ros__parameters'),
    (b'node: {ros__parameters: {codebook: 3}}', 'expected ros__parameters'),
    (b'node: {ros__parameters: {codebook: {shape: null}}}', 'shape|not iterable'),
    (b'node: {ros__parameters: {codebook: {}}}', 'codebook.shape'),
], ids=str)
def test_a_file_without_a_codebook_is_an_error(tmp_path, content, words):
    path = tmp_path / 'codebook.yaml'
    path.write_bytes(content)
    with pytest.raises(CodebookError, match=words) as caught:
        Codebook.load(path)
    assert str(caught.value).startswith(f'{path}: ')


SHIPPED = {'codebook.yaml': 'ambiguity', 'codebook_ambiguity.yaml': 'ambiguity',
           'codebook_crlb.yaml': 'crlb'}


@pytest.mark.slow
@pytest.mark.parametrize('name', SHIPPED)
def test_shipped_codebooks_are_feasible_and_match_their_metadata(name):
    """On held-out positions; observing all elements would give about 0.018 m^2."""
    scenario, codebook = Scenario(), Codebook.load(CONFIG / name)
    codebook.check(scenario)
    positions = scenario.sample_positions(2000, np.random.default_rng(2024))
    average = crlb(scenario, codebook, positions).mean()
    assert 0.018 < average <= {'crlb': 0.0405, 'ambiguity': 0.05}[SHIPPED[name]]
    assert codebook.average_crlb_m2 == pytest.approx(average, rel=0.1)
    assert Provenance.parse(codebook.provenance).objective == SHIPPED[name]


@pytest.mark.slow
def test_the_default_codebook_confuses_fewer_positions():
    """On held-out pairs."""
    scenario, rng = Scenario(), np.random.default_rng(77)
    firsts = scenario.sample_positions(1500, rng)
    held_out = PairwiseErrorCost(
        scenario, firsts, draw_confusable(scenario, firsts, rng), tolerance=1e-3)
    values = {name: held_out.value(Codebook.load(CONFIG / name)) for name in SHIPPED}
    assert values['codebook.yaml'] < 0.8 * values['codebook_crlb.yaml']
    assert values['codebook.yaml'] < 0.6 * held_out.value(directional_codebook(scenario))
