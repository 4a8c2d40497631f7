"""Types of command line arguments."""

import argparse
import os
from pathlib import Path

import pytest

from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    check_distinct,
    input_file,
    interval,
    nonnegative_float,
    output_file,
    output_folder,
    picture_file,
    positive_float,
    positive_int,
    share,
)


def test_ranges_of_numbers_contain_their_ends_unless_open():
    assert nonnegative_float('0') == share('0') == 0
    assert (share('1'), positive_float('1e-9'), positive_int('1')) == (1, 1e-9, 1)
    for kind, text in (
            (positive_float, '0.0'), (nonnegative_float, '-1e-09'), (share, '1.01'),
            (positive_int, '0'), (positive_int, '1000000001')):
        with pytest.raises(argparse.ArgumentTypeError, match=f'^{text}, expected '):
            kind(text)
    for text in ('1.5', 'x', ''):
        with pytest.raises(argparse.ArgumentTypeError, match=f"^'{text}', expected an integer, "):
            positive_int(text)


def test_help_states_each_default_once():
    parser = ArgumentParser()
    parser.add_argument('--seed', default=0, help='seed')
    parser.add_argument('--jobs', default=-1, help='jobs (default: one per core)')
    parser.add_argument('--file', help='file')
    parser.add_argument('--quiet', action='store_true', help='quiet')
    lines = parser.format_help().splitlines()[-4:]
    assert [' '.join(line.split()[2:]) for line in lines[:3]] == [
        'seed (default: 0)', 'jobs (default: one per core)', 'file']
    assert lines[3].split() == ['--quiet', 'quiet']


def test_an_interval_has_two_positive_ends_in_order():
    assert (interval('2:3e9'), interval('2:2')) == ((2, 3e9), (2, 2))
    for text in ('3:2', '2', '0:2', 'a:2', ':', ''):
        with pytest.raises(argparse.ArgumentTypeError, match=f"^'{text}', expected LOW:HIGH"):
            interval(text)


def test_an_error_is_one_line_with_a_hint_and_exits_with_code_2(capsys):
    parser = ArgumentParser(prog='command')
    parser.add_argument('--option')
    with pytest.raises(SystemExit, match='^2$'):
        parser.parse_args(['two\nlines'])
    assert capsys.readouterr().err == (
        'command: error: unrecognized arguments: two lines; see command --help\n')
    with pytest.raises(SystemExit, match='^2$'):
        parser.parse_args(['--opt', 'abbreviated'])


def test_subcommands_have_the_same_parser(capsys):
    parser = ArgumentParser(prog='command')
    parser.add_subparsers().add_parser('verb')
    with pytest.raises(SystemExit, match='^2$'):
        parser.parse_args(['verb', '--bogus'])
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_pipe_is_an_input_file(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    assert input_file(str(tmp_path / 'pipe')) == tmp_path / 'pipe'


def test_a_folder_that_can_be_made_is_an_output_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ('.', 'new/one', str(tmp_path / 'new' / 'two')):
        assert output_folder(name) == Path(name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', ['', 'file', 'file/folder', '/proc/folder'])
def test_a_folder_that_cannot_be_made_is_an_error(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file').touch()
    with pytest.raises(argparse.ArgumentTypeError, match='expected a folder'):
        output_folder(name)


def test_an_output_differs_from_inputs_and_other_outputs(tmp_path, capsys):
    (tmp_path / 'x').mkdir()
    (tmp_path / 'a.png').touch()
    file, same = f'{tmp_path}/a.png', f'{tmp_path}/x/../a.png'
    parser = ArgumentParser(prog='command')
    parser.add_argument('--c', type=picture_file)
    parser.add_argument('a', type=input_file, nargs='?')
    parser.add_argument('--b', type=output_file)
    parser.add_argument('--d', type=output_file, default=file)
    check_distinct(parser, parser.parse_args([file, '--c', f'{tmp_path}/c.png']), 'd')
    for arguments, name, other, unused in (
            ([file, '--c', same], '--c', 'a', 'd'),
            (['--b', file, '--c', same], '--b', '--c', 'd'), ([file], '--d', 'a', '')):
        with pytest.raises(SystemExit, match='^2$'):
            check_distinct(parser, parser.parse_args(arguments), unused)
        error = capsys.readouterr().err
        assert f'argument {name}: ' in error
        assert f', expected a file other than {other};' in error
