"""The scenarios and codebooks in config/."""

import dataclasses
import re
from pathlib import Path

import pytest
import yaml

from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario

CONFIG = Path(__file__).parents[1] / 'config'
SCENARIOS = ('table1', 'quick', 'wideband', 'bandplan', 'hall')
FILES = ('multipath', 'channel')
CODEBOOKS = {path.stem for path in CONFIG.glob('codebook*.yaml')}
FIELDS = {field.name: field.metadata['declared'].unit for field in dataclasses.fields(Scenario)}


def test_every_file_is_a_scenario_a_codebook_or_one_of_parameters():
    assert {path.stem for path in CONFIG.glob('*.yaml')} == {*SCENARIOS, *CODEBOOKS, 'parameters'}


def test_table1_equals_the_default_and_has_every_field():
    assert Scenario.from_yaml(CONFIG / 'table1.yaml') == Scenario()
    content = yaml.safe_load((CONFIG / 'table1.yaml').read_text(encoding='utf-8'))
    assert list(content) == list(FIELDS)


@pytest.mark.parametrize('name', SCENARIOS)
def test_every_line_states_its_unit(name):
    text = (CONFIG / f'{name}.yaml').read_text(encoding='utf-8')
    lines = re.findall(r'^(\w+): (.*?) +# (.*)$', text, re.MULTILINE)
    assert [field for field, _, _ in lines] == list(yaml.safe_load(text))
    for field, _, comment in lines:
        assert re.findall(r'\[([^],]+)\]', comment) == [FIELDS[field]] * bool(FIELDS[field])


@pytest.mark.parametrize('name', SCENARIOS)
def test_yaml_reads_all_values_as_numbers(name):
    content = yaml.safe_load((CONFIG / f'{name}.yaml').read_text(encoding='utf-8'))
    for field, value in content.items():
        if field in FILES:
            assert value is None or (CONFIG / value).is_file()
            continue
        entries = value.values() if isinstance(value, dict) else value
        for number in entries if isinstance(value, dict | list) else [value]:
            assert isinstance(number, int | float | None)


def test_quick_is_smaller_and_wideband_has_four_bands():
    quick, wideband = (Scenario.from_yaml(CONFIG / f'{name}.yaml')
                       for name in ('quick', 'wideband'))
    assert all(quick.sizes[symbol] < size for symbol, size in Scenario().sizes.items()
               if symbol != 'N_B')
    assert wideband.n_bands == 4
    assert wideband.changes().keys() == {'center_frequencies_hz'}


def test_the_hall_is_table1_on_traced_paths():
    hall = Scenario.from_yaml(CONFIG / 'hall.yaml')
    assert hall.changes().keys() == set(FILES)
    assert hall.multipath.about['positions'] == 100
    assert not hall.multipath.about['warnings']
    low, high = hall.roi_bounds_m
    assert ((low <= hall.channel.users) & (hall.channel.users <= high)).all()


def test_the_band_plan_has_the_spectrum_and_the_pilots_of_table1():
    plan, table1 = Scenario.from_yaml(CONFIG / 'bandplan.yaml'), Scenario()
    assert plan.changes().keys() == {'center_frequencies_hz', 'n_frames'}
    assert plan.n_bands * plan.n_frames == table1.n_bands * table1.n_frames
    low, high = table1.center_frequencies_hz
    assert all(low <= frequency <= high for frequency in plan.center_frequencies_hz)


@pytest.mark.parametrize('name', sorted(CODEBOOKS))
def test_codebooks_fit_their_scenarios(name):
    scenario = name.removeprefix('codebook').removeprefix('_')
    file = CONFIG / f'{scenario if scenario in SCENARIOS else "table1"}.yaml'
    Codebook.load(CONFIG / f'{name}.yaml').check(Scenario.from_yaml(file))


def test_the_default_codebook_is_found_in_a_clone():
    default = Codebook.load(default_codebook_file())
    assert default.id == Codebook.load(CONFIG / 'codebook.yaml').id
