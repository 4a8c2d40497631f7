"""Dictionaries of bounded size."""

from rhs_isac_ros.protocol.role import NewestDict


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
    for key in (1, 2, 3, 4):
        newest.put(key, None, pinned=1)
    assert list(newest) == [1, 3, 4]
