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


def test_an_empty_cache_has_nothing_in_use():
    assert CodebookCache().in_use == ''


def test_the_codebook_taken_last_is_kept_until_another_is_taken():
    cache = CodebookCache()
    for name in 'abc':
        cache.put(name, name.upper())
    assert cache.take('a') == 'A'
    assert cache.in_use == 'a'
    for name in 'defg':
        cache.put(name, name.upper())
    assert sorted(cache) == ['a', 'e', 'f', 'g']
    assert cache.take('g') == 'G'
    cache.put('h', 'H')
    assert sorted(cache) == ['a', 'f', 'g', 'h']
    with pytest.raises(KeyError):
        cache.take('e')
    assert cache.in_use == 'g'
