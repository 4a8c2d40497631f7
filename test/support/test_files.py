"""Atomic writing of files, and files of arrays with a description."""

import io
import json
import os
import zipfile

import numpy as np
import pytest

from rhs_isac_ros.support import files

NAMES = {'one', 'two'}


@pytest.mark.parametrize('content', ['größer', 'größer'.encode(),
                                     lambda stream: stream.write('größer'.encode())],
                         ids=['text', 'bytes', 'function'])
def test_a_file_has_the_content(tmp_path, content):
    path = tmp_path / 'file'
    files.write_whole(path, content)
    assert path.read_text(encoding='utf-8') == 'größer'


@pytest.mark.parametrize('failing', ['replace', 'content'])
def test_a_failing_write_leaves_only_the_old_file(tmp_path, monkeypatch, failing):
    path = tmp_path / 'file'
    files.write_whole(path, 'old')

    def fail(*args, **kwargs):
        raise OSError('no space left')

    with monkeypatch.context() as patch:
        if failing != 'content':
            patch.setattr(os, failing, fail)
        with pytest.raises(OSError, match='no space left'):
            files.write_whole(path, fail if failing == 'content' else 'new')
    assert path.read_text(encoding='utf-8') == 'old'
    assert os.listdir(tmp_path) == ['file']


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path, full_disk):
    path = tmp_path / 'file'
    with full_disk(1024), pytest.raises(OSError, match=f"too large: '{path}'$"):
        files.write_whole(path, bytes(2048))
    assert not list(tmp_path.iterdir())
    # Neither is the temporary file named if it cannot even be created.
    with pytest.raises(OSError, match=f"No such file or directory: '{path}/none'$"):
        files.write_whole(path / 'none', b'')


@pytest.mark.parametrize('is_rescued', [True, False])
def test_the_result_of_long_work_is_rescued(tmp_path, monkeypatch, is_rescued):
    rescue, path = tmp_path / 'rescue', tmp_path / 'none' / 'file'
    rescue.mkdir()
    monkeypatch.setattr('tempfile.tempdir', str(rescue))

    def save(target):
        files.write_whole(target if is_rescued or target == path else path, 'result')
    with pytest.raises(OSError, match=f"'{path}'") as error:
        files.save_or_rescue(save, path)
    saved = list(rescue.iterdir())
    assert len(saved) == is_rescued
    for folder in saved:
        assert str(error.value).endswith(f'; the result is in {folder / "file"}')
        assert (folder / 'file').read_text(encoding='utf-8') == 'result'


def test_a_file_in_a_missing_folder_is_not_writable(tmp_path):
    files.check_writable(tmp_path / 'file')
    path = tmp_path / 'none' / 'file'
    with pytest.raises(OSError, match=f'^{path}: expected a file in a directory that exists'):
        files.check_writable(path)


@pytest.fixture
def file(tmp_path):
    files.write_archive(tmp_path / 'file', {'one': np.arange(3.0), 'two': 2.0},
                  {'format': 4, 'text': 'é'})
    return tmp_path / 'file'


def test_arrays_and_description_are_read_back(file):
    arrays, about = files.read_archive(file, 'thing', 4, NAMES)
    np.testing.assert_array_equal(arrays['one'], np.arange(3.0))
    assert (arrays['two'], about) == (2.0, {'text': 'é'})


@pytest.mark.parametrize(('version', 'names'), [(5, NAMES), (4, {'one'}), (4, {*NAMES, 'three'})])
def test_another_format_or_other_arrays_are_refused(file, version, names):
    with pytest.raises(
            files.ArchiveError,
            match=f'file: not a thing, expected a thing file of format {version}'):
        files.read_archive(file, 'thing', version, names)


@pytest.mark.parametrize('about', [json.dumps([1]), json.dumps({})])
def test_a_description_of_another_kind_is_refused(tmp_path, about):
    np.savez(tmp_path / 'file.npz', one=1, two=2, about=about)
    with pytest.raises(files.ArchiveError, match='not a thing'):
        files.read_archive(tmp_path / 'file.npz', 'thing', 4, NAMES)


@pytest.mark.parametrize('read', [files.read_yaml, files.read_arrays])
def test_the_error_of_a_missing_file_names_it_once(tmp_path, read):
    path = tmp_path / 'missing'
    with pytest.raises(ValueError, match=f'^{path}: cannot be read: No such file or directory$'):
        read(path)


@pytest.mark.slow
def test_a_flipped_bit_is_an_error_or_changes_no_content(file):
    content = file.read_bytes()
    n_errors = 0
    for place in range(len(content)):
        damaged = bytearray(content)
        damaged[place] ^= 1
        file.write_bytes(damaged)
        try:
            arrays, about = files.read_archive(file, 'thing', 4, NAMES)
        except files.ArchiveError:
            n_errors += 1
        else:
            # The format repeats a part of its headers, and does not protect the time of writing.
            np.testing.assert_array_equal(arrays['one'], np.arange(3.0))
            assert (arrays['two'], about) == (2.0, {'text': 'é'})
    assert n_errors > len(content) / 2


@pytest.mark.parametrize('content', [b'', b'n_frames: 4\n', b'\x89PNG\r\n'])
def test_a_file_of_another_format_is_named(tmp_path, content):
    """NumPy would take it for pickled objects, and propose to execute them."""
    (tmp_path / 'a.npz').write_bytes(content)
    with pytest.raises(files.ArchiveError, match='cannot be read: no arrays, expected .* .npz'):
        files.read_arrays(tmp_path / 'a.npz')


@pytest.mark.parametrize('compression', [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
def test_damaged_compressed_arrays_are_an_error(tmp_path, compression):
    array, path = io.BytesIO(), tmp_path / 'file.npz'
    np.save(array, np.arange(200.0))
    with zipfile.ZipFile(path, 'w', compression) as archive:
        archive.writestr('one.npy', array.getvalue())
    content = path.read_bytes()
    for place in range(40, len(content) // 2, 3):
        path.write_bytes(content[:place] + bytes([content[place] ^ 255]) + content[place + 1:])
        with pytest.raises(files.ArchiveError, match='cannot be read'):
            files.read_arrays(path)


@pytest.mark.parametrize(('text', 'value'), [
    ('3', 3), ('-3', -3), ('+3', 3), ('0', 0), ('1.5', 1.5), ('-.5e-3', -0.5e-3), ('1.', 1.0),
    ('2.5e9', 2.5e9), ('0.010', 0.01), ('.inf', float('inf')), ('true', True), ('~', None)])
def test_numbers_in_yaml_are_decimal(text, value):
    found = files.parse_yaml(f'[{text}, {{a: {text}}}]')
    assert found == [value, {'a': value}]
    assert type(found[0]) is type(value)


@pytest.mark.parametrize('text', [
    '010', '-010', '08', '0x1F', '0b11', '1_000', '1:30', '-1:30', '1:30.5', '00.5', '1_0.5',
    '28e9'])
def test_other_notations_in_yaml_are_text(text):
    """YAML 1.1 reads 010 as 8, and -1:30 as -90."""
    assert files.parse_yaml(f'[{text}]') == [text]


@pytest.mark.parametrize(('text', 'error'), [
    ('n: 1\nm: 2\nn: 3', 'n: repeated in line 3'), ('{n: 1, n: 1}', 'n: repeated in line 1'),
    ('a:\n  b: {c: 1, c: 2}', 'c: repeated in line 2'), ('- {1: a, 1: b}', '1: repeated'),
    ("'n': 1\nn: 2", 'n: repeated in line 2'), ('[1]: 2', 'unhashable key'),
    ('? [1]\n: 2', 'unhashable key')])
def test_a_key_that_yaml_repeats_is_an_error(tmp_path, text, error):
    (tmp_path / 'a.yaml').write_text(text)
    with pytest.raises(ValueError, match=f'a.yaml: cannot be read: .*{error}'):
        files.read_yaml(tmp_path / 'a.yaml')
