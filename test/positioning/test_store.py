"""Tables on disk."""

import dataclasses
import os
import pwd
import shutil
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.positioning import store, templates
from rhs_isac_ros.positioning.outside import tabulate_outside
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.system import System


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    return Scenario(n_subbands=2, n_frames=2, elements_per_side=4, roi_center_m=(4, 0, 0),
                    roi_size_m=(2, 2, 1))


@pytest.fixture(scope='module')
def system(scenario, random_beams) -> System:
    return System(scenario, random_beams(scenario, np.random.default_rng(0)))


@pytest.fixture
def computed(monkeypatch):
    """Ids of the codebooks for which tables were computed."""
    ids, original = [], templates.tabulate

    def tabulate(system, progress=None):
        ids.append(system.codebook.id)
        return original(system, progress)
    monkeypatch.setattr(templates, 'tabulate', tabulate)
    return ids


def table_name(system) -> str:
    return f'table-{store.table_key(system)}.npy'


def only_file(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def assert_same(table, system, expected=None):
    expected = expected or templates.tabulate(system)
    assert table.keys() == expected.keys()
    for name, array in expected.items():
        assert table[name].dtype == array.dtype
        np.testing.assert_array_equal(table[name], array)


def test_a_table_is_computed_once_and_then_mapped(tmp_path, system, computed):
    for _ in range(3):
        table = load_table(system, tmp_path / 'new' / 'folder')
        for array in table.values():
            assert array.flags.aligned
            assert not array.flags.writeable
            while not isinstance(array, np.memmap):
                array = array.base
    assert computed == [system.codebook.id]
    assert_same(table, system)
    assert only_file(tmp_path / 'new' / 'folder').name == table_name(system)


def test_the_table_of_users_outside_is_computed_when_it_is_used(tmp_path, system, computed):
    load_table(system, tmp_path)
    for _ in range(2):
        outside = load_table(system, tmp_path, outside=True)
    assert computed == [system.codebook.id]
    assert_same(outside, system, tabulate_outside(system))
    assert len(list(tmp_path.iterdir())) == 2


def test_without_a_folder_no_table_is_kept(tmp_path, system, computed, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    load_table(system)
    load_table(system)
    assert len(computed) == 2
    assert not list(tmp_path.iterdir())


def truncate(path):
    os.truncate(path, path.stat().st_size * 2 // 3)


def flip_bit(share):
    def damage(path):
        content = bytearray(path.read_bytes())
        content[int(share * len(content))] ^= 1
        path.write_bytes(content)
    return damage


@pytest.mark.parametrize('damage', [
    truncate, flip_bit(0), flip_bit(0.002), flip_bit(0.5), flip_bit(0.999),
    lambda path: path.write_bytes(b''),
    lambda path: path.write_bytes(b'no table'),
    lambda path: np.save(path, np.zeros(7)),
    lambda path: np.save(path, np.array([{'key': 1}], object), allow_pickle=True),
    lambda path: (path.unlink(), path.mkdir()),
], ids=['truncated', 'magic', 'header', 'middle', 'end', 'empty', 'text', 'array', 'pickle',
        'folder'])
def test_a_damaged_table_is_computed_again(tmp_path, system, computed, damage, recwarn):
    load_table(system, tmp_path)
    damage(only_file(tmp_path))
    assert_same(load_table(system, tmp_path), system)
    assert computed[:2] == [system.codebook.id] * 2


def test_a_table_of_another_codebook_or_scenario_is_not_used_under_a_wrong_name(
        tmp_path, scenario, system, computed, random_beams):
    others = [System(scenario, random_beams(scenario, np.random.default_rng(1))),
              System(Scenario(**scenario.changes() | {'noise_psd_dbm_hz': -170.0}),
                     system.codebook)]
    load_table(system, tmp_path)
    first = only_file(tmp_path)
    for other in others:
        shutil.copy(first, tmp_path / table_name(other))
        assert_same(load_table(other, tmp_path), other)
    assert len(list(tmp_path.iterdir())) == 3


def test_surfaces_that_differ_in_their_pose_share_a_table(tmp_path, scenario, system, computed):
    placed = dataclasses.replace(scenario, pose=Pose((0.0, 3.0, 1.0)))
    load_table(system, tmp_path)
    load_table(System(placed, system.codebook), tmp_path)
    assert computed == [system.codebook.id]


def test_a_folder_that_cannot_be_written_is_a_warning(tmp_path, system):
    (tmp_path / 'file').write_text('')
    with pytest.warns(RuntimeWarning, match='the table cannot be stored: .*file'):
        assert_same(load_table(system, tmp_path / 'file'), system)


def test_the_oldest_tables_beyond_32_are_deleted(tmp_path, system):
    names = [f'table-{n}.npy' for n in range(34)]
    for age, name in enumerate(names):
        (tmp_path / name).write_text('')
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    (tmp_path / 'other.npy').write_text('')
    load_table(system, tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {*names[:31], table_name(system), 'other.npy'}


@pytest.mark.parametrize(('variable', 'expected'), [
    ('/some/cache', '/some/cache/rhs_isac_ros'), ('', '/me/.cache/rhs_isac_ros'),
    ('relative', '/me/.cache/rhs_isac_ros')])
def test_default_folder_follows_the_xdg_convention(monkeypatch, variable, expected):
    monkeypatch.setenv('HOME', '/me')
    monkeypatch.setenv('XDG_CACHE_HOME', variable)
    assert store.default_folder() == Path(expected)


def test_a_user_without_a_home_directory_has_no_default_folder(monkeypatch):
    def unknown(uid):
        raise KeyError(uid)
    monkeypatch.delenv('XDG_CACHE_HOME', raising=False)
    monkeypatch.delenv('HOME', raising=False)
    monkeypatch.setattr(pwd, 'getpwuid', unknown)
    with pytest.warns(RuntimeWarning, match='the table is not stored: no home directory'):
        assert store.default_folder() is None


def test_the_progress_of_a_table_is_reported_up_to_the_end(system, tmp_path):
    shares = []
    for _ in range(2):
        load_table(system, tmp_path, shares.append)
    # A stored table takes no time.
    assert shares == [1.0]
