"""Atomic writing of files, and files of arrays with a description."""

import json
import os

import numpy as np
import pytest

from rhs_isac_ros.support.files import (
    ArchiveError,
    check_writable,
    read_archive,
    write_archive,
    write_whole,
)

NAMES = {'one', 'two'}


@pytest.mark.parametrize('content', ['größer', 'größer'.encode(),
                                     lambda stream: stream.write('größer'.encode())],
                         ids=['text', 'bytes', 'function'])
def test_a_file_has_the_content(tmp_path, content):
    path = tmp_path / 'file'
    write_whole(path, content)
    assert path.read_text(encoding='utf-8') == 'größer'


@pytest.mark.parametrize('failing', ['replace', 'content'])
def test_a_failing_write_leaves_only_the_old_file(tmp_path, monkeypatch, failing):
    path = tmp_path / 'file'
    write_whole(path, 'old')

    def fail(*args, **kwargs):
        raise OSError('no space left')

    with monkeypatch.context() as patch:
        if failing != 'content':
            patch.setattr(os, failing, fail)
        with pytest.raises(OSError, match='no space left'):
            write_whole(path, fail if failing == 'content' else 'new')
    assert path.read_text(encoding='utf-8') == 'old'
    assert os.listdir(tmp_path) == ['file']


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match='none'):
        write_whole(tmp_path / 'none' / 'file', 'x')


def test_a_file_in_a_missing_folder_is_not_writable(tmp_path):
    check_writable(tmp_path / 'file')
    path = tmp_path / 'none' / 'file'
    with pytest.raises(OSError, match=f'^{path}: expected a file in a directory that exists'):
        check_writable(path)


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
