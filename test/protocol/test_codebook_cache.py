"""Dictionaries of bounded size, and items that roles derive from codebooks."""

import pytest

from rhs_isac_ros.protocol.role import CodebookCache, NewestDict


def test_the_oldest_entries_are_discarded_and_counted():
    newest = NewestDict(2)
    assert [newest.put(key, key * 10) for key in (1, 2, 3, 4)] == [0, 0, 1, 1]
    assert newest == {3: 30, 4: 40}


def test_an_entry_stored_again_is_the_newest():
    newest = NewestDict(2)
    for key in (1, 2, 1, 3):
        newest.put(key, None)
    assert list(newest) == [1, 3]


def test_a_pinned_entry_is_kept_beyond_the_limit():
    newest = NewestDict(2)
    newest.pinned = 1
    for key in (1, 2, 3, 4):
        newest.put(key, None)
    assert list(newest) == [1, 3, 4]


@pytest.fixture
def shelf():
    """A cache with items a, b and c, none of which is in use."""
    made = CodebookCache()
    for name in 'abc':
        made.put(name, name.upper())
    return made


def test_a_stored_item_can_be_taken(shelf):
    assert [shelf.take(name) for name in 'abc'] == ['A', 'B', 'C']
    assert list(shelf) == ['a', 'b', 'c']


def test_an_empty_cache_has_nothing_in_use():
    shelf = CodebookCache()
    assert shelf.in_use == ''
    assert list(shelf) == []
    assert '' not in shelf


def test_the_item_taken_last_is_in_use(shelf):
    shelf.take('a')
    assert shelf.in_use == 'a'
    shelf.take('c')
    assert shelf.in_use == 'c'


def test_the_oldest_item_is_discarded(shelf):
    shelf.put('d', 'D')
    assert list(shelf) == ['b', 'c', 'd']
    assert 'a' not in shelf
    with pytest.raises(KeyError):
        shelf.take('a')
    assert shelf.in_use == ''


def test_the_item_in_use_is_kept(shelf):
    shelf.take('a')
    for name in 'defg':
        shelf.put(name, name.upper())
    assert list(shelf) == ['a', 'e', 'f', 'g']
    assert shelf.take('a') == 'A'


def test_an_item_no_longer_in_use_is_discarded_by_age(shelf):
    shelf.take('a')
    shelf.put('d', 'D')
    shelf.take('d')
    shelf.put('e', 'E')
    assert 'a' not in shelf
    assert list(shelf) == ['b', 'c', 'd', 'e']


def test_an_item_stored_again_is_the_latest(shelf):
    shelf.put('a', 'again')
    shelf.put('d', 'D')
    assert list(shelf) == ['c', 'a', 'd']
    assert shelf.take('a') == 'again'


def test_the_size_is_bounded(shelf):
    for n in range(1000):
        shelf.put(str(n), n)
        shelf.take(str(n - n % 7))
    assert len(list(shelf)) == 4
