"""The declaration of values, and what is said about those that are invalid."""

import math

import pytest

from rhs_isac_ros.support.fields import Field

TIME = Field(float, low=0.5, high=3600.0, unit='s')
LIST = Field(list, high=1e6, low=-1e6)


@pytest.mark.parametrize(('declared', 'valid'), [
    (TIME, [0.5, 3600.0]), (Field(int, low=1, high=2**32), [1, 2**32]),
    (Field(float, low=0, is_open=True), [5e-324, 1e308]), (Field(float), [-1e308]),
    (LIST, [[], [1e6]]), (Field(str), ['']), (Field(bool), [False]),
    (Field(str, choices=('a', 'b')), ['b'])])
def test_valid_values_are_no_problem(declared, valid):
    assert [declared.problem(value) for value in valid] == [''] * len(valid)


@pytest.mark.parametrize(('declared', 'value', 'problem'), [
    (TIME, 0.25, '0.25, expected 0.5 to 3600 s'), (TIME, math.nan, 'nan, expected 0.5 to 3600 s'),
    (TIME, 1, '1, expected a number, 0.5 to 3600 s'),
    (Field(int, low=1, high=2**32), 0, '0, expected 1 to 4294967296'),
    (Field(int, low=1), True, 'True, expected an integer, at least 1'),
    (Field(float, low=0, is_open=True), 0.0, '0.0, expected above 0'),
    (Field(float, low=0), math.inf, 'inf, expected at least 0'),
    (Field(float), math.nan, 'nan, expected finite numbers'),
    (LIST, [2e6], '[2000000.0], expected -1e+06 to 1e+06'),
    (LIST, 'no', "'no', expected a list of numbers, -1e+06 to 1e+06"),
    (Field(bool), 1, '1, expected true or false'),
    (Field(str, choices=('a', 'b')), 'c', "'c', expected one of a, b")])
def test_an_invalid_value_comes_with_what_is_expected(declared, value, problem):
    assert declared.problem(value) == problem
