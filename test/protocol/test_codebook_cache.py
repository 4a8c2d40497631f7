"""What roles keep for a codebook."""

import pytest

from rhs_isac_ros.protocol.codebook_cache import CodebookCache


@pytest.fixture
def shelf():
    """A shelf with a, b and c, of which none is in use."""
    made = CodebookCache()
    for name in 'abc':
        made.put(name, name.upper())
    return made


def test_what_was_put_can_be_taken(shelf):
    assert [shelf.take(name) for name in 'abc'] == ['A', 'B', 'C']
    assert shelf.ids() == ['a', 'b', 'c']


def test_an_empty_shelf_has_nothing_in_use():
    shelf = CodebookCache()
    assert shelf.in_use == ''
    assert shelf.ids() == []
    assert '' not in shelf


def test_what_was_taken_last_is_in_use(shelf):
    shelf.take('a')
    assert shelf.in_use == 'a'
    shelf.take('c')
    assert shelf.in_use == 'c'


def test_the_oldest_goes(shelf):
    shelf.put('d', 'D')
    assert shelf.ids() == ['b', 'c', 'd']
    assert 'a' not in shelf
    with pytest.raises(KeyError):
        shelf.take('a')
    assert shelf.in_use == ''


def test_what_is_in_use_stays(shelf):
    shelf.take('a')
    for name in 'defg':
        shelf.put(name, name.upper())
    assert shelf.ids() == ['a', 'e', 'f', 'g']
    assert shelf.take('a') == 'A'


def test_what_is_no_longer_in_use_goes_with_its_age(shelf):
    shelf.take('a')
    shelf.put('d', 'D')
    shelf.take('d')
    shelf.put('e', 'E')
    assert 'a' not in shelf
    assert shelf.ids() == ['b', 'c', 'd', 'e']


def test_what_is_put_again_is_new(shelf):
    shelf.put('a', 'again')
    shelf.put('d', 'D')
    assert shelf.ids() == ['c', 'a', 'd']
    assert shelf.take('a') == 'again'


def test_the_memory_does_not_grow(shelf):
    for n in range(1000):
        shelf.put(str(n), n)
        shelf.take(str(n - n % 7))
    assert len(shelf.ids()) == 4


def test_who_only_looks_changes_nothing(shelf):
    shelf.take('b')
    assert shelf.peek('a') == 'A'
    assert shelf.peek('z') is None
    assert shelf.in_use == 'b'
