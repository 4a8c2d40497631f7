"""Errors for optional libraries that are not installed."""

import sys

import pytest

from rhs_isac_ros.support.optional import MissingLibraryError, optional_import


def test_a_successful_import_has_no_effect():
    with optional_import('a test'):
        import json
    assert json.loads('1') == 1


@pytest.mark.parametrize(('extra', 'hint'), [
    ('watch', r" \(pip install 'rhs_isac_ros\[watch\]'\)"),
    ('view', r" \(pip install 'rhs_isac_ros\[view\]'; in a clone: scripts/setup view\)"),
    ('', '')])
def test_the_error_names_purpose_library_and_extra(monkeypatch, extra, hint):
    monkeypatch.setitem(sys.modules, 'json.decoder', None)
    words = f'^a test needs json, which is not installed{hint}$'
    with pytest.raises(MissingLibraryError, match=words):
        with optional_import('a test', extra):
            import json.decoder  # noqa: F401


def test_other_errors_propagate():
    with pytest.raises(ZeroDivisionError):
        with optional_import('a test'):
            raise ZeroDivisionError
