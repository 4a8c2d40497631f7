"""Items that roles derive from codebooks."""

import pytest

from rhs_isac_ros.protocol.role import CodebookCache


@pytest.fixture
def shelf():
    """A cache with items a, b and c, none of which is in use."""
    made = CodebookCache()
    for name in 'abc':
        made.put(name, name.upper())
    return made


def test_a_stored_item_can_be_taken(shelf):
    assert [shelf.take(name) for name in 'abc'] == ['A', 'B', 'C']
    assert shelf.ids() == ['a', 'b', 'c']


def test_an_empty_cache_has_nothing_in_use():
    shelf = CodebookCache()
    assert shelf.in_use == ''
    assert shelf.ids() == []
    assert '' not in shelf


def test_the_item_taken_last_is_in_use(shelf):
    shelf.take('a')
    assert shelf.in_use == 'a'
    shelf.take('c')
    assert shelf.in_use == 'c'


def test_the_oldest_item_is_discarded(shelf):
    shelf.put('d', 'D')
    assert shelf.ids() == ['b', 'c', 'd']
    assert 'a' not in shelf
    with pytest.raises(KeyError):
        shelf.take('a')
    assert shelf.in_use == ''


def test_the_item_in_use_is_kept(shelf):
    shelf.take('a')
    for name in 'defg':
        shelf.put(name, name.upper())
    assert shelf.ids() == ['a', 'e', 'f', 'g']
    assert shelf.take('a') == 'A'


def test_an_item_no_longer_in_use_is_discarded_by_age(shelf):
    shelf.take('a')
    shelf.put('d', 'D')
    shelf.take('d')
    shelf.put('e', 'E')
    assert 'a' not in shelf
    assert shelf.ids() == ['b', 'c', 'd', 'e']


def test_an_item_stored_again_is_the_latest(shelf):
    shelf.put('a', 'again')
    shelf.put('d', 'D')
    assert shelf.ids() == ['c', 'a', 'd']
    assert shelf.take('a') == 'again'


def test_the_size_is_bounded(shelf):
    for n in range(1000):
        shelf.put(str(n), n)
        shelf.take(str(n - n % 7))
    assert len(shelf.ids()) == 4


def test_peeking_changes_nothing(shelf):
    shelf.take('b')
    assert shelf.peek('a') == 'A'
    assert shelf.peek('z') is None
    assert shelf.in_use == 'b'
