"""The first of several nodes with one user number owns it while it answers."""

import pytest

from rhs_isac_ros.protocol.base_station_memory import SILENT_S, UserInstances

FIRST, SECOND = 1_700_000_000 * 10**9, 1_800_000_000 * 10**9
SILENT = 10.0 + SILENT_S


@pytest.fixture
def instances():
    result = UserInstances()
    assert result.accept(2, FIRST, 10.0) == []
    return result


@pytest.mark.parametrize('other', [SECOND, FIRST - 1, 0])
def test_the_first_owns_the_number(instances, other):
    assert instances.owner(2) == FIRST
    assert instances.is_taken(2, other, 10.0)
    assert not instances.is_taken(2, FIRST, 10.0)
    assert not instances.is_taken(3, other, 10.0)
    assert instances.owner(3) == 0


@pytest.mark.parametrize(('missed', 'now_s', 'taken'), [
    (3, SILENT, False), (2, SILENT, True), (3, SILENT - 0.01, True), (2, 1000.0, True)])
def test_the_owner_changes_after_a_second_and_three_beacons_without_its_answer(
        instances, missed, now_s, taken):
    for _ in range(missed):
        assert instances.is_taken(2, SECOND, now_s)
        instances.reject(2)
    assert instances.is_taken(2, SECOND, now_s) == taken


def test_an_owner_that_answers_in_between_keeps_the_number(instances):
    for now_s in range(20, 40):
        instances.reject(2)
        instances.reject(2)
        assert instances.is_taken(2, SECOND, now_s)
        instances.accept(2, FIRST, now_s)
    assert instances.owner(2) == FIRST


def test_the_next_owner_has_the_rights_of_the_first(instances):
    for _ in range(3):
        instances.reject(2)
    assert instances.accept(2, SECOND, SILENT) == []
    assert instances.owner(2) == SECOND
    assert instances.is_taken(2, FIRST, SILENT)


def test_a_number_that_was_released_has_no_owner(instances):
    instances.forget([1, 2], 10.0)
    assert not instances.is_taken(2, SECOND, 10.0)


def test_a_conflict_is_logged_once_until_it_has_ended(instances):
    instances.reject(2)
    (first,) = instances.accept(2, FIRST, 11.0)
    assert first.warning
    assert first.text == ('user 2: two nodes have this number; the first one, '
                          'started 2023-11-14 22:13:20 UTC, is served')
    instances.reject(2)
    assert instances.accept(2, FIRST, 15.0) == []
    instances.forget([], 19.0)
    assert instances.conflicts() == {'conflict.user_2': first.text}
    instances.forget([], 20.1)
    assert instances.conflicts() == {}
    instances.reject(2)
    assert len(instances.accept(2, FIRST, 21.0)) == 1
