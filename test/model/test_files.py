"""Atomic writing of files."""

import os

import pytest

from rhs_isac_ros.model.files import check_writable, write_whole


@pytest.mark.parametrize('content', ['größer', 'größer'.encode(),
                                     lambda stream: stream.write('größer'.encode())],
                         ids=['text', 'bytes', 'function'])
def test_a_file_has_the_content_and_is_readable_by_all(tmp_path, content):
    path = tmp_path / 'file'
    write_whole(path, content)
    assert path.read_text(encoding='utf-8') == 'größer'
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize('failing', ['replace', 'chmod', 'fdopen', 'content'])
def test_a_failing_write_leaves_only_the_old_file(tmp_path, monkeypatch, failing):
    path = tmp_path / 'file'
    write_whole(path, 'old')

    def fail(*args, **kwargs):
        if failing == 'fdopen':
            os.close(args[0])
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
