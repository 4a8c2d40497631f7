"""Files of arrays with a description."""

import json

import numpy as np
import pytest

from rhs_isac_ros.model.archive import ArchiveError, read_archive, write_archive

NAMES = {'one', 'two'}


@pytest.fixture
def file(tmp_path):
    write_archive(tmp_path / 'file', {'one': np.arange(3.0), 'two': 2.0},
                  {'format': 4, 'text': 'é'})
    return tmp_path / 'file'


def test_arrays_and_description_are_read_back(file):
    arrays, about = read_archive(file, 'thing', 4, NAMES)
    np.testing.assert_array_equal(arrays['one'], np.arange(3.0))
    assert (arrays['two'], about) == (2.0, {'text': 'é'})


@pytest.mark.parametrize(('version', 'names'), [(5, NAMES), (4, {'one'}), (4, {*NAMES, 'three'})])
def test_another_format_or_other_arrays_are_refused(file, version, names):
    with pytest.raises(
            ArchiveError, match=f'file: not a thing, expected a thing file of format {version}'):
        read_archive(file, 'thing', version, names)


@pytest.mark.parametrize('about', [json.dumps([1]), json.dumps({})])
def test_a_description_of_another_kind_is_refused(tmp_path, about):
    np.savez(tmp_path / 'file.npz', one=1, two=2, about=about)
    with pytest.raises(ArchiveError, match='not a thing'):
        read_archive(tmp_path / 'file.npz', 'thing', 4, NAMES)


def test_pickled_objects_are_refused(tmp_path):
    np.savez(tmp_path / 'file.npz', one=np.array([object()]), two=2, about='{"format": 4}')
    with pytest.raises(ArchiveError, match='cannot be read'):
        read_archive(tmp_path / 'file.npz', 'thing', 4, NAMES)
