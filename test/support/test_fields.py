"""The declaration of values, and what is said about those that are invalid."""

import decimal
import fractions
import math

import numpy as np
import pytest

from rhs_isac_ros.support.fields import Field, finite, to_number

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


@pytest.mark.parametrize(('value', 'number'), [
    (3, 3.0), (np.float32(0.5), 0.5), (np.int8(3), 3.0), (np.array(2), 2.0),
    (np.array([[0.25]]), 0.25), (fractions.Fraction(1, 4), 0.25), (decimal.Decimal('0.5'), 0.5),
    ('28e9', 28e9), ('-1.5', -1.5), ('.5', 0.5), ('0', 0.0), ('+7.', 7.0)])
def test_real_numbers_and_arrays_of_one_are_numbers(value, number):
    found = to_number(value, float)
    assert type(found) is float
    assert found == number


@pytest.mark.parametrize('value', [
    True, np.True_, 3 + 2j, np.complex128(3 + 2j), np.array(3 + 0j), np.array([1.0, 2.0]),
    np.array([]), np.ma.masked, np.ma.array([1.0]), np.array(['1']), np.timedelta64(3, 's'), b'3',
    '010', '-1:30', '1_000', '0x1F', ' 3', 'nan', 'inf', '', None, [3.0]], ids=repr)
def test_other_values_are_no_numbers(value):
    assert to_number(value, float) is value


def test_an_integer_has_no_fraction_and_no_notation():
    assert to_number(np.array([[3]]), int) == 3
    for value in (3.0, '3', 'x'):
        assert to_number(value, int) is value
    assert type(to_number(np.float64(3), int)) is float


def test_an_invalid_number_is_an_error_with_its_name():
    assert finite('speed_mps', np.array([[2]]), 0.0) == 2.0
    for value, text in ((math.nan, 'nan, expected at least 0'), (-1, '-1.0, expected at least 0'),
                        (1j, '1j, expected a number, at least 0')):
        with pytest.raises(ValueError, match=f'^speed_mps: {text}'):
            finite('speed_mps', value, 0.0)
