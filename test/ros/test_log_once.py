"""Errors that are logged once."""

import types

import pytest

from rhs_isac_ros.ros.diagnostics import LogOnce


@pytest.fixture
def logged():
    """List that collects the errors that `log_once` logs."""
    return []


@pytest.fixture
def log_once(logged):
    logger = types.SimpleNamespace(error=logged.append)
    return LogOnce(types.SimpleNamespace(get_logger=lambda: logger))


def test_only_the_first_error_of_each_subject_is_logged(log_once, logged):
    for subject, text in (('a', 'one'), ('a', 'one'), ('a', 'two'), ('b', 'one')):
        log_once.error(subject, text)
    assert logged == ['one', 'one']


def test_a_changed_text_is_logged_on_request(log_once, logged):
    for text in ('one', 'one', 'two', 'two', 'one'):
        log_once.error('a', text, repeat_if_changed=True)
    assert logged == ['one', 'two', 'one']


def test_a_cleared_subject_is_logged_again(log_once, logged):
    log_once.error('a', 'one')
    log_once.error('b', 'two')
    log_once.clear('a')
    log_once.clear('never logged')
    log_once.error('a', 'one')
    log_once.error('b', 'two')
    assert logged == ['one', 'two', 'one']
