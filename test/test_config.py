"""The scenarios and codebooks in config/."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_intervals_m
from rhs_isac_ros.support.files import read_yaml
from rhs_isac_ros.system import System

CONFIG = Path(__file__).parents[1] / 'config'
CODEBOOKS = {path.stem for path in CONFIG.glob('codebook*.yaml')}
SCENARIOS = {name: Scenario.from_yaml(CONFIG / f'{name}.yaml')
             for name in (
                 'table1', 'quick', 'wideband', 'bandplan', 'hall', 'lab', 'lab_walk',
                 'resonant', 'coupled')}


def test_every_file_is_a_scenario_a_codebook_a_site_or_one_of_parameters():
    assert {path.stem for path in CONFIG.glob('*.yaml')} == {
        *SCENARIOS, *CODEBOOKS, 'lab_system', 'lab_walk_system', 'site', 'parameters'}


@pytest.mark.parametrize(('name', 'changed'), [
    ('table1', set()), ('wideband', {'center_frequencies_hz'}), ('hall', {'multipath', 'channel'}),
    ('bandplan', {'center_frequencies_hz', 'n_frames'}), ('resonant', {'board'}),
    ('coupled', {'board'})])
def test_scenarios_change_only_what_their_names_promise(name, changed):
    assert SCENARIOS[name].changes().keys() == changed


def test_table1_lists_all_fields():
    fields = {field.name for field in dataclasses.fields(Scenario)}
    assert read_yaml(CONFIG / 'table1.yaml').keys() == fields


def test_quick_is_smaller_and_wideband_has_four_bands():
    assert all(SCENARIOS['quick'].sizes[symbol] < size
               for symbol, size in Scenario().sizes.items() if symbol != 'N_B')
    assert SCENARIOS['wideband'].n_bands == 4


def test_the_hall_has_traced_paths_for_its_region():
    hall = SCENARIOS['hall']
    assert hall.multipath.about['positions'] == 100
    assert not hall.multipath.about['warnings']
    low, high = hall.roi_bounds_m
    assert ((low <= hall.channel.users) & (hall.channel.users <= high)).all()


def test_the_lab_has_the_elements_and_the_times_of_its_board():
    lab = SCENARIOS['lab']
    np.testing.assert_allclose(element_intervals_m(lab), [0.020, 0.013], atol=5e-6)
    assert (lab.n_elements, lab.amplitude_levels, lab.n_feeds) == (256, 2, 1)
    system = System.from_yaml(CONFIG / 'lab_system.yaml')
    assert (system.scenario, system.codebook.id) == (
        lab, Codebook.load(CONFIG / 'codebook_lab.yaml').id)
    surface = system.surface
    np.testing.assert_array_equal(surface.applied(np.eye(256)), 1 - 2 * np.eye(256))
    assert surface.is_exact


def test_users_walk_in_the_same_lab():
    walk = System.from_yaml(CONFIG / 'lab_walk_system.yaml')
    rest = System.from_yaml(CONFIG / 'lab_system.yaml')
    assert walk.scenario == SCENARIOS['lab_walk']
    assert dataclasses.replace(
        walk.scenario, user_speed_std_mps=0.0, max_user_speed_mps=0.01) == rest.scenario
    np.testing.assert_array_equal(walk.radiation, rest.radiation)


def test_the_band_plan_has_the_spectrum_and_the_pilots_of_table1():
    plan, table1 = SCENARIOS['bandplan'], Scenario()
    assert plan.n_bands * plan.n_frames == table1.n_bands * table1.n_frames
    low, high = table1.center_frequencies_hz
    assert all(low <= frequency <= high for frequency in plan.center_frequencies_hz)


@pytest.mark.parametrize('name', sorted(CODEBOOKS))
def test_codebooks_fit_their_scenarios(name):
    scenario = SCENARIOS.get(name.removeprefix('codebook_'), Scenario())
    Codebook.load(CONFIG / f'{name}.yaml').check(scenario)


def test_the_library_fits_the_band_plan_and_its_codebook():
    library = Library.load(CONFIG / 'library_bandplan.npz')
    library.check(SCENARIOS['bandplan'])
    assert library.plan.start == Codebook.load(CONFIG / 'codebook_bandplan.yaml').id


def test_the_default_codebook_is_found_in_a_clone():
    default = Codebook.default()
    assert default.id == Codebook.load(CONFIG / 'codebook.yaml').id
