"""Types of command line arguments."""

import argparse

import pytest

from rhs_isac_ros.model.arguments import positive_int


@pytest.mark.parametrize(('text', 'number'), [('1', 1), ('250', 250)])
def test_positive_int_parses_integers_from_one(text, number):
    assert positive_int(text) == number


@pytest.mark.parametrize(('text', 'expected'), [
    ('0', 'at least 1'), ('-3', 'at least 1'), ('1.5', 'an integer'), ('x', 'an integer'),
    ('', 'an integer')])
def test_anything_else_is_an_error_that_names_the_expectation(text, expected):
    with pytest.raises(argparse.ArgumentTypeError, match=f', expected {expected}$'):
        positive_int(text)
