"""Libraries of codebooks: cells, files, and their construction."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.codebook import CodebookError, library, random_codebook
from rhs_isac_ros.codebook.__main__ import main
from rhs_isac_ros.codebook.library import Library, Plan
from rhs_isac_ros.codebook.objective import OBJECTIVES, sobol
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.jobs import HERE

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.6e9), n_subbands=2, n_frames=2, elements_per_side=4,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 1, 0.5))


@pytest.fixture(scope='module')
def start(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


@pytest.fixture(scope='module')
def plan(start):
    return Plan(SCENARIO.unplaced.id, start.id, 'ambiguity', (0.1, 0.4), (0.8, 2.0))


@pytest.fixture(scope='module')
def built(plan, start):
    (codebooks,) = HERE.run([library.codebooks_of(
        SCENARIO, plan.cells(SCENARIO), start, plan.objective)])
    return Library.of(plan, plan.cells(SCENARIO), codebooks)


def test_every_position_is_within_half_a_pitch_of_a_cell(plan):
    centres = np.array([cell.centre_m for cell in plan.cells(SCENARIO) if cell.std_m == 0.1])
    places = SCENARIO.sample_positions(300, np.random.default_rng(2))
    apart = np.abs(places[:, None] - centres).max(axis=2).min(axis=1)
    assert apart.max() <= 0.4
    assert len(centres) == 3 * 2 * 1


@pytest.mark.slow
def test_the_codebook_is_that_of_the_nearest_cell_with_the_next_wider_spread(built):
    cells = built.plan.cells(SCENARIO)
    place = np.array(cells[3].centre_m) + 0.05
    assert built.codebook_at(place, 0.07) is built.codebooks[3]
    assert built.codebook_at(place, 0.1) is built.codebooks[3]
    assert built.codebook_at(place, 0.2) is built.codebooks[-1]
    assert built.codebook_at(place, 0.5) is None


@pytest.mark.slow
def test_a_codebook_has_a_lower_objective_in_its_cell(built, start):
    for number in (0, 6):
        cell = built.plan.cells(SCENARIO)[number]
        rng = np.random.default_rng(3)
        places = cell.positions(SCENARIO, sobol(SCENARIO, 64, rng))
        average = OBJECTIVES['ambiguity'](SCENARIO, places, rng, prior=cell)
        assert average.value(built.codebooks[number]) < 0.9 * average.value(start)


def test_a_file_has_all_content(built, tmp_path):
    built.save(tmp_path / 'library.npz')
    found = Library.load(tmp_path / 'library.npz')
    found.check(SCENARIO)
    assert found.plan == built.plan
    assert found.id == built.id
    np.testing.assert_array_equal(found.centres_m, built.centres_m)


def test_a_damaged_file_is_an_error(built, tmp_path):
    path = tmp_path / 'library.npz'
    built.save(path)
    content = path.read_bytes()
    analog = built.analog.tobytes()
    path.write_bytes(content.replace(analog, analog[:-1] + bytes([analog[-1] ^ 1])))
    with pytest.raises(CodebookError, match=f'^{path}: ') as caught:
        Library.load(path)
    assert str(caught.value).count(str(path)) == 1


@pytest.mark.parametrize(('name', 'value'), [
    ('centres_m', np.nan), ('centres_m', 1j), ('spreads_m', np.inf), ('spreads_m', -0.2),
    ('spreads_m', 0.0)])
def test_cells_without_a_place_or_a_spread_are_an_error(built, tmp_path, name, value):
    path = tmp_path / 'library.npz'
    cells = np.full_like(getattr(built, name), value, type(value))
    dataclasses.replace(built, **{name: cells}).save(path)
    with pytest.raises(CodebookError, match=f'^{path}: {name}: '):
        Library.load(path)


def test_a_library_for_another_scenario_or_an_incomplete_one_is_an_error(built):
    other = dataclasses.replace(SCENARIO, roi_size_m=(2.0, 1.0, 0.4))
    with pytest.raises(CodebookError, match='^scenario: '):
        built.check(other)
    part = Library.of(built.plan, built.plan.cells(SCENARIO)[:3], built.codebooks[:3])
    with pytest.raises(CodebookError, match='^codebooks: 3, expected 7'):
        part.check(SCENARIO)


@pytest.mark.parametrize(('name', 'factor'), [('centres_m', 1000), ('spreads_m', 2)])
def test_cells_that_are_not_those_of_the_plan_are_an_error(built, name, factor):
    moved = dataclasses.replace(built, **{name: factor * getattr(built, name)})
    assert moved.id != built.id
    with pytest.raises(CodebookError, match=rf'^{name}\[0\]: .*, expected .* of the plan'):
        moved.check(SCENARIO)


def test_the_order_of_the_cells_is_part_of_the_library(built):
    order = np.array([1, 0, *range(2, 7)])
    swapped = dataclasses.replace(built, centres_m=built.centres_m[order])
    assert swapped.id != built.id
    with pytest.raises(CodebookError, match=r'^centres_m\[0\]'):
        swapped.check(SCENARIO)


@pytest.mark.slow
def test_the_pitch_is_the_largest_with_a_small_loss(start, monkeypatch):
    losses = dict(zip(
        (0.8, 0.625, 0.5, 0.4, 0.3, 0.2), (0.3, 0.1, 0.04, 0.01, 0.0, 0.0), strict=True))
    reports, cells = [], []

    def optimised(cell, start, **options):
        cells.append(np.array(cell[0]))
        other = random_codebook(SCENARIO, np.random.default_rng(len(cells)))
        return {'codebook': other.to_parameters(), 'history': [], 'reason': ''}

    def compared(cell, **options):
        # The cells of the last pitch, of which each is at most half a pitch from its place.
        reach = 2 * max(np.abs(one - two).max() for one, two in zip(
            cells[:12], cells[-12:], strict=True))
        loss = losses[min(one for one in losses if one >= reach - 1e-9)]
        return {'values': [1 + loss, 1.0]}

    monkeypatch.setattr(library, 'optimised', optimised)
    monkeypatch.setattr(library, 'compared', compared)
    wide = dataclasses.replace(SCENARIO, roi_size_m=(4.0, 4.0, 1.0), roi_center_m=(4, 0, 0))
    found = library.make_library(
        wide, start, 'error', (0.1,), 0.05, lambda *report: reports.append(report))
    found.check(wide)
    assert found.plan.pitches_m == (pytest.approx(0.5),)
    assert [pitch for _, pitch, _ in reports] == pytest.approx([0.8, 0.625, 0.5])
    assert [loss for *_, loss in reports] == pytest.approx([0.3, 0.1, 0.04])


@pytest.mark.slow
def test_the_command_continues_after_an_interruption_and_on_other_workers(
        start, tmp_path, capsys, monkeypatch):
    pytest.importorskip('joblib')
    monkeypatch.setattr(library, '_N_TRIALS', 1)
    monkeypatch.setattr(library, '_STEPS', 2)
    monkeypatch.setattr(library, '_N_POSITIONS', 4)
    scenario_file = tmp_path / 'scenario.yaml'
    scenario_file.write_text(
        'center_frequencies_hz: [2.5e+9, 2.6e+9]\nn_subbands: 2\nn_frames: 2\n'
        'elements_per_side: 4\nroi_center_m: [4, 0, 0]\nroi_size_m: [1, 1, 0.5]\n',
        encoding='utf-8')
    start.save(tmp_path / 'start.yaml')
    output, optimised, calls = tmp_path / 'library.npz', library.optimised, []
    arguments = ['--scenario', str(scenario_file), '--start', str(tmp_path / 'start.yaml'),
                 '--objective', 'ambiguity', '--output', str(output), '--quiet', '--loss', '10',
                 '--spreads', '0.4', '0.1', '--jobs']

    def interrupted(**options):
        calls.append(options)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return optimised(**options)

    with monkeypatch.context() as patch:
        patch.setattr(library, 'optimised', interrupted)
        assert main(['library', *arguments, '1']) == 130
    assert len([*(tmp_path / 'library.npz.jobs').glob('optimisation-*')]) == 3
    assert main(['library', *arguments, '2']) == 0
    assert '5 codebooks: 4 for 0.1 m, 1 for 0.4 m' in capsys.readouterr().out
    assert Library.load(output).id == library.make_library(
        dataclasses.replace(SCENARIO, roi_size_m=(1, 1, 0.5)), start, 'ambiguity', (0.1, 0.4),
        10).id
    assert not (tmp_path / 'library.npz.jobs').exists()
