"""The newest of several nodes with one user number owns it while it answers."""

import pytest

from rhs_isac_ros.protocol.user_scheduler import UserInstances

NEWER, OLDER = 1_700_000_000 * 10**9, 1_600_000_000 * 10**9


@pytest.fixture
def instances():
    result = UserInstances()
    result.accept(2, NEWER)
    return result


def test_the_newest_owns_the_number(instances):
    assert instances.owner(2) == NEWER
    assert instances.is_superseded(2, OLDER)
    assert not instances.is_superseded(2, NEWER)
    assert not instances.is_superseded(2, NEWER + 1)
    assert not instances.is_superseded(3, OLDER)
    assert instances.owner(3) == 0


def test_the_owner_changes_after_three_beacons_without_its_answer(instances):
    for _ in range(2):
        instances.reject(2, 0.0)
    assert instances.is_superseded(2, OLDER)
    instances.accept(2, NEWER)
    for _ in range(3):
        assert instances.is_superseded(2, OLDER)
        instances.reject(2, 0.0)
    assert not instances.is_superseded(2, OLDER)
    instances.accept(2, OLDER)
    assert instances.owner(2) == OLDER


def test_a_number_that_was_released_has_no_owner(instances):
    instances.forget([1, 2], 0.0)
    assert not instances.is_superseded(2, OLDER)


def test_a_conflict_is_logged_once_until_it_has_ended(instances):
    (first,) = instances.reject(2, 0.0)
    assert first.warning
    assert first.text == ('user 2: two nodes have this number; the newer one, '
                          'started 2023-11-14 22:13:20 UTC, is served')
    assert instances.reject(2, 4.0) == []
    instances.forget([], 8.0)
    assert instances.conflicts() == {'conflict.user_2': first.text}
    instances.forget([], 9.1)
    assert instances.conflicts() == {}
    assert len(instances.reject(2, 10.0)) == 1
