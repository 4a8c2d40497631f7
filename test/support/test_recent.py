"""Functions that keep their recent values."""

import copy
import pickle

import pytest

from rhs_isac_ros.support.recent import Recent


class Squares:
    """An object with such a function as an attribute."""

    def __init__(self):
        self.computed = []
        self.of = Recent(self._of, 2)

    def _of(self, number):
        self.computed.append(number)
        return number**2


def test_the_values_of_the_most_recent_arguments_are_kept():
    squares = Squares()
    assert [squares.of(n) for n in (1, 2, 1, 3, 1, 2)] == [1, 4, 1, 9, 1, 4]
    # The value of 2 was dropped for that of 3, because 1 had been used later.
    assert squares.computed == [1, 2, 3, 2]


def test_values_without_an_argument_are_computed_together():
    squares, calls = Squares(), []
    squares.of(3)
    squares.of.keep([2, 3], lambda new: calls.append(new) or [0])
    assert (calls, squares.of(2), squares.of(3)) == ([[2]], 0, 9)


def test_a_value_of_none_is_kept_too():
    calls = []
    found = Recent(calls.append, 1)
    assert [found(1), found(1)] == [None, None]
    assert calls == [1]


def test_an_exception_is_no_value():
    root = Recent(int, 1)
    for _ in range(2):
        with pytest.raises(ValueError, match='invalid literal'):
            root('x')
    assert root('4') == 4


@pytest.mark.parametrize('copied', [copy.copy, copy.deepcopy, lambda one: pickle.loads(
    pickle.dumps(one))])
def test_a_copy_starts_without_values(copied):
    squares = Squares()
    squares.of(3)
    assert copied(squares.of)(3) == 9
    assert squares.computed[:1] == [3]


def test_the_copy_of_an_object_calls_its_own_function():
    squares = Squares()
    squares.of(3)
    other = pickle.loads(pickle.dumps(squares))
    assert other.of(5) == 25
    assert (squares.computed, other.computed) == ([3], [3, 5])
