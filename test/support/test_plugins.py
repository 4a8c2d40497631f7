"""Plug-ins of other packages."""

import re
import sys

import pytest

from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.plugins import PluginError

# A group that no installed package has.
GROUP = 'rhs_isac_ros.strolls'


def test_names_are_those_of_the_installed_packages(install):
    assert plugins.names(GROUP) == ()
    install('strolls', 'def stroll(): return 1', {GROUP: {'stroll': 'stroll', 'amble': 'stroll'}})
    install('strides', '', {GROUP: {'march': 'march'}, 'another.group': {'x': 'y'}})
    assert plugins.names(GROUP) == ('amble', 'march', 'stroll')


def test_the_object_of_an_entry_point_is_imported_and_called(install):
    install('strolls', 'def stroll(a, *, b): return a, b', {GROUP: {'stroll': 'stroll'}})
    assert plugins.load(GROUP, 'stroll').__name__ == 'stroll'
    assert plugins.make(GROUP, 'stroll', tuple, 1, b=2) == (1, 2)


def test_the_error_for_an_unknown_name_lists_the_installed_plugins(install):
    with pytest.raises(PluginError, match=f"'stroll', expected a plug-in of {GROUP}; .*: none"):
        plugins.load(GROUP, 'stroll')
    install('strolls', '', {GROUP: {'b': 'x', 'a': 'x'}})
    with pytest.raises(PluginError, match="'stroll', expected .*; installed: a, b"):
        plugins.load(GROUP, 'stroll')


@pytest.mark.parametrize(('code', 'words'), [
    ('import no_such_module', "ModuleNotFoundError: No module named 'no_such_module'"),
    ('1 / 0', 'ZeroDivisionError: division by zero'),
    ('', "AttributeError: module 'strolls' has no attribute 'stroll'"),
    ('def', 'SyntaxError: '),
])
def test_the_error_for_a_failed_import_names_the_entry_point(install, code, words):
    install('strolls', code, {GROUP: {'stroll': 'stroll'}})
    prefix = f'entry point {GROUP}: stroll = strolls:stroll of strolls: cannot be loaded: '
    with pytest.raises(PluginError, match=re.escape(prefix + words)):
        plugins.load(GROUP, 'stroll')


def test_the_error_for_a_failed_call_names_the_entry_point(install):
    install('strolls', 'def stroll(): raise KeyError("speed")', {GROUP: {'stroll': 'stroll'}})
    with pytest.raises(PluginError, match=r"strolls:stroll of strolls: failed: KeyError: 'speed'"):
        plugins.make(GROUP, 'stroll', tuple)
    with pytest.raises(PluginError, match='failed: TypeError: .* positional argument'):
        plugins.make(GROUP, 'stroll', tuple, 1)


def test_a_traceback_begins_in_the_code_of_the_plug_in(install, capsys):
    install('strolls', 'def stroll(): return pace()\ndef pace(): return {}["speed"]',
            {GROUP: {'stroll': 'stroll', 'gone': 'gone'}})

    def made(name):
        plugins.make(GROUP, name, tuple)
    assert exit_code_of(lambda: made('stroll'), (PluginError,), 'walk') == 2
    first, head, *frames, last = capsys.readouterr().err.splitlines()
    assert first.startswith('walk: error: entry point') and first.endswith("KeyError: 'speed'")
    assert head == 'Traceback (most recent call last):' and last == "KeyError: 'speed'"
    assert frames[0].endswith('strolls.py", line 1, in stroll')
    # No code of the plug-in has been called.
    assert exit_code_of(lambda: made('gone'), (PluginError,), 'walk') == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_code_that_imports_is_not_in_the_traceback(install, capsys, monkeypatch):
    backport = pytest.importorskip('importlib_metadata')
    monkeypatch.setattr(sys, 'meta_path', [backport.MetadataPathFinder(), *sys.meta_path])
    test_a_traceback_begins_in_the_code_of_the_plug_in(install, capsys)


def test_the_error_for_a_duplicate_name_names_both_packages(install):
    install('strolls', 'def stroll(): return 1', {GROUP: {'stroll': 'stroll'}})
    install('ambles', 'def stroll(): return 2', {GROUP: {'stroll': 'stroll'}})
    with pytest.raises(PluginError, match=r"'stroll': .*ambles.* and .*strolls.*, expected one"):
        plugins.load(GROUP, 'stroll')


class Stroll:
    """An object that is given in place of a name."""

    pace = 1


def test_an_object_or_its_module_and_name_is_a_plugin(tmp_path, monkeypatch):
    (tmp_path / 'my_strolls.py').write_text('class Far:\n    class Away: pass\n')
    monkeypatch.syspath_prepend(tmp_path)
    away = plugins.load(GROUP, 'my_strolls:Far.Away')
    assert plugins.name_of(away) == 'my_strolls:Far.Away'
    assert plugins.load(GROUP, away) is away
    name = plugins.name_of(Stroll)
    assert plugins.is_reference(name) and name.endswith(':Stroll')
    assert plugins.load(GROUP, name) is Stroll
    assert isinstance(plugins.make(GROUP, Stroll, Stroll), Stroll)
    with pytest.raises(PluginError, match=f'^{name}: failed: TypeError'):
        plugins.make(GROUP, Stroll, Stroll, 1)


@pytest.mark.parametrize(('name', 'words'), [
    ('no_such_module:x', 'no_such_module:x: cannot be loaded: ModuleNotFoundError'),
    ('numpy:no_such_name', 'numpy:no_such_name: cannot be loaded: AttributeError')])
def test_a_name_without_an_object_is_an_error(name, words):
    with pytest.raises(PluginError, match=words):
        plugins.load(GROUP, name)


@pytest.mark.parametrize('name', ['os:system', 'numpy:load', 'idlelib.idle:x'])
def test_a_file_can_name_only_subclasses_outside_of_the_standard_library(name):
    with pytest.raises(PluginError, match=f'^{name}: .*expected a '):
        plugins.load(GROUP, name, base=Stroll)
