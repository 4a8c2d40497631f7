"""Users that the base station waits for and serves, and the nodes that have their numbers."""

import numpy as np
import pytest

from rhs_isac_ros.protocol.user_registry import (
    LAST_NUMBER,
    POLICIES,
    SILENT_S,
    UserRegistry,
    join_users,
    parse_users,
)

pytestmark = pytest.mark.usefixtures('plain_beams')

# Number of users that a beacon invites, and of seniors.
INVITED = 8


@pytest.fixture
def make():
    """Function that returns a registry."""
    def build(policy='round_robin', seed=0):
        return UserRegistry(policy, np.random.default_rng(seed))
    return build


def cycle(registry, *users):
    """Return the user served in a cycle in which these users answer, in this order."""
    registry.invite(0)
    for user in users:
        registry.add_answer(user)
    registry.remove_absent()
    return registry.select()


def test_there_are_three_policies():
    assert set(POLICIES) == {'round_robin', 'first', 'random'}


def test_round_robin_serves_the_user_served_longest_ago(make):
    registry = make()
    assert [cycle(registry, 3, 1, 2) for _ in range(6)] == [1, 2, 3, 1, 2, 3]
    assert cycle(registry, 2, 3) == 2
    assert [cycle(registry, 1, 2, 3) for _ in range(4)] == [1, 3, 2, 1]


def test_round_robin_serves_a_new_user_after_those_that_wait(make):
    registry = make()
    assert [cycle(registry, 2, 3) for _ in range(5)] == [2, 3, 2, 3, 2]
    # User 3 waits, user 2 was served last; of new users the lower number comes first.
    assert [cycle(registry, 1, 2, 3, 9) for _ in range(8)] == [3, 1, 9, 2, 3, 1, 9, 2]


def test_a_user_that_leaves_and_returns_is_not_served_more_often(make):
    registry = make()
    served = [cycle(registry, 1, 2, 3)]
    for n in range(40):
        if n % 2:
            registry.remove(1)
        served.append(cycle(registry, 1, 2, 3))
    counts = [served.count(user) for user in (1, 2, 3)]
    assert max(counts) <= 21
    assert min(counts) >= 9


@pytest.mark.parametrize('order', [(1, 2, 3), (3, 2, 1)])
def test_a_user_lost_in_each_of_its_cycles_delays_the_others_by_at_most_one_turn(
        make, order):
    registry = make()
    served = []
    for _ in range(30):
        served.append(cycle(registry, *order))
        if served[-1] == 1:
            registry.remove(1)
    for user in (2, 3):
        turns = [n for n, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns])) <= 3


def test_first_serves_the_first_to_answer(make):
    registry = make('first')
    assert [cycle(registry, 3, 1, 2), cycle(registry, 2, 3), cycle(registry, 2, 1)] == [3, 2, 2]


def test_random_is_uniform_and_reproducible(make):
    registry = make('random')
    served = [cycle(registry, 1, 2, 3) for _ in range(3000)]
    for user in (1, 2, 3):
        assert 900 < served.count(user) < 1100
    again, other = make('random'), make('random', seed=1)
    assert [cycle(again, 1, 2, 3) for _ in range(20)] == served[:20]
    assert [cycle(other, 1, 2, 3) for _ in range(20)] != served[:20]


def test_random_serves_only_users_that_answered(make):
    registry = make('random')
    cycle(registry, 1, 2, 3)
    assert {cycle(registry, 2, 3) for _ in range(50)} == {2, 3}


def test_a_returning_user_has_no_priority(make):
    registry = make()
    assert [cycle(registry, 2, 3, 9) for _ in range(3)] == [2, 3, 9]
    registry.remove(9)
    assert [cycle(registry, 2, 3) for _ in range(4)] == [2, 3, 2, 3]
    assert [cycle(registry, 2, 3, 9) for _ in range(3)] == [2, 9, 3]


def test_a_cycle_begins_without_answers(make):
    registry = make()
    cycle(registry, 1, 2)
    assert list(registry.answered) == [1, 2]
    registry.invite(0)
    assert not registry.answered


def test_without_registered_users_one_answer_is_enough(make):
    registry = make()
    registry.invite(0)
    assert registry.is_complete_with(5)


@pytest.mark.parametrize('policy', ['round_robin', 'random'])
def test_the_selection_waits_for_all_registered_users(make, policy):
    registry = make(policy)
    cycle(registry, 1, 2, 3)
    registry.invite(0)
    assert not registry.is_complete_with(1)
    registry.add_answer(1)
    assert not registry.is_complete_with(4)
    assert not registry.is_complete_with(2)
    registry.add_answer(2)
    assert not registry.is_complete_with(1)
    assert registry.is_complete_with(3)


def test_first_needs_one_answer_only(make):
    registry = make('first')
    cycle(registry, 1, 2, 3)
    registry.invite(0)
    assert registry.is_complete_with(2)


def test_a_user_is_removed_after_three_missed_beacons(make):
    registry = make()
    cycle(registry, 1, 2)
    for _ in range(3):
        registry.invite(0)
        assert not registry.is_complete_with(1)
        registry.add_answer(1)
        registry.remove_absent()
        registry.select()
    registry.invite(0)
    assert registry.is_complete_with(1)


def test_an_answer_resets_the_count_of_missed_beacons(make):
    registry = make()
    cycle(registry, 1, 2)
    for _ in range(2):
        cycle(registry, 1)
    cycle(registry, 1, 2)
    for _ in range(3):
        registry.invite(0)
        assert not registry.is_complete_with(1)
        registry.add_answer(1)
        registry.remove_absent()
        registry.select()


def test_a_removed_user_is_not_waited_for_until_it_answers(make):
    registry = make()
    cycle(registry, 1, 2)
    registry.remove(2)
    registry.invite(0)
    assert registry.is_complete_with(1)
    registry.add_answer(1)
    registry.add_answer(2)
    registry.remove_absent()
    registry.select()
    registry.invite(0)
    assert not registry.is_complete_with(1)


def test_a_registered_user_is_waited_for_but_has_not_answered(make):
    registry = make()
    cycle(registry, 1)
    registry.register(2)
    assert list(registry.answered) == [1]
    registry.invite(0)
    assert not registry.is_complete_with(1)
    registry.add_answer(1)
    registry.remove_absent()
    assert registry.select() == 1
    assert cycle(registry, 1, 2) == 2


def test_registering_again_does_not_change_the_turn(make):
    registry = make()
    cycle(registry, 1, 2)
    cycle(registry, 1, 2)
    registry.register(1)
    registry.register(2)
    assert cycle(registry, 2, 1) == 1


def test_a_new_policy_keeps_the_turns(make):
    registry = make()
    cycle(registry, 1, 2, 3)
    cycle(registry, 1, 2, 3)
    registry.policy = 'first'
    assert cycle(registry, 2, 1, 3) == 2
    registry.policy = 'round_robin'
    assert cycle(registry, 1, 2, 3) == 3


def served_in_turn(registry, present, n):
    """Return the users served in cycles in which the invited ones of `present` answer."""
    served = []
    for _ in range(n):
        answering, attempt = [], 0
        while not answering:
            first, last = registry.invite(attempt)
            answering = [user for user in present if first <= user <= last]
            if not answering:
                assert not registry.all_invited
                registry.remove_absent()
                attempt += 1
        for user in answering:
            registry.add_answer(user)
        registry.remove_absent()
        served.append(registry.select())
    return served


@pytest.mark.parametrize('n', [0, 1, INVITED])
def test_few_users_are_invited_together(make, n):
    registry = make()
    for user in range(1, n + 1):
        registry.register(3 * user)
    assert registry.invite(0) == (1, LAST_NUMBER)
    assert registry.all_invited


@pytest.mark.parametrize('policy', POLICIES)
def test_of_many_users_few_are_invited(make, policy):
    registry, numbers = make(policy), [7 * n for n in range(1, 101)]
    for user in numbers:
        registry.register(user)
    ranges = set()
    for _ in range(400):
        first, last = registry.invite(0)
        ranges.add((first, last))
        invited = [user for user in numbers if first <= user <= last]
        assert 1 <= len(invited) <= INVITED
        for user in invited:
            assert registry.is_complete_with(0) is (policy == 'first')
            registry.add_answer(user)
        assert registry.is_complete_with(0)
        registry.select()
    # Together, the ranges contain every number once.
    ranges = sorted(ranges)
    assert (ranges[0][0], ranges[-1][1]) == (1, LAST_NUMBER)
    assert all(first == last + 1 for (_, last), (first, _)
               in zip(ranges, ranges[1:], strict=False))


@pytest.mark.parametrize('present', [range(1, 1001), range(5, 5000, 37)], ids=['dense', 'sparse'])
def test_no_user_waits_longer_than_a_round(make, present):
    registry = make()
    n = len(present)
    served_in_turn(registry, present, 1)
    served = served_in_turn(registry, present, 3 * n)
    for user in present:
        turns = [turn for turn, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns, 3 * n])) <= n


def test_a_user_that_is_always_late_does_not_delay_the_users_of_other_ranges(make):
    registry, late, others = make(), 3, [user for user in range(1, 41) if user != 3]
    for user in (late, *others):
        registry.register(user)
    served = []
    for _ in range(3 * len(others)):
        served += served_in_turn(registry, others, 1)
        # Its acks arrive after the grant.
        registry.register(late)
    for user in others:
        turns = [turn for turn, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns, len(served)])) <= len(others) + 1


def test_new_users_between_many_are_served_within_two_rounds(make):
    registry = make()
    served_in_turn(registry, range(2, 202, 2), 100)
    served = served_in_turn(registry, range(1, 211), 210 + 100)
    assert set(served) == {*range(1, 211)}


def test_users_that_leave_together_delay_the_others_by_few_beacons(make):
    registry = make()
    served_in_turn(registry, range(1, 1001), 300)
    served = served_in_turn(registry, range(501, 1001), 600)
    assert len(registry) == 500
    assert set(served) == {*range(501, 1001)}


def test_only_invited_users_miss_a_beacon(make):
    registry = make()
    served_in_turn(registry, range(1, 101), 100)
    for _ in range(5):
        registry.invite(0)
        registry.add_answer(1)
        lost = registry.remove_absent()
        assert set(lost) <= {*range(1, INVITED + 1)}
        registry.select()
    assert len(registry) > 100 - 2 * INVITED


# Seniors

SENIORS, OTHERS = [*range(1, INVITED + 1)], [*range(101, 121)]


@pytest.fixture
def crowd(make):
    """A registry with seniors, and with other users."""
    registry = make()
    for user in SENIORS:
        registry.register(user)
        registry.end_cycle(user, 0.0, 0.1, completed=True)
    for user in OTHERS:
        registry.register(user)
    return registry


def fail(registry, user, begin_s=10.0):
    registry.end_cycle(user, begin_s, begin_s + 1.0, completed=False)


def next_users(registry, n, now_s=11.0):
    """Return the users served in cycles without duration, in which all users answer."""
    users = []
    for _ in range(n):
        users.append(cycle(registry, *SENIORS, *OTHERS))
        registry.end_cycle(users[-1], now_s, now_s, completed=True)
    return users


def test_without_failures_all_users_take_turns(crowd):
    assert sorted(next_users(crowd, 28)) == [*SENIORS, *OTHERS]


def test_seniors_are_served_first_for_as_long_as_the_cycle_of_another_user_took(crowd):
    fail(crowd, OTHERS[3])
    assert {*next_users(crowd, 10, now_s=11.9)} == {*SENIORS}
    assert {*next_users(crowd, 1, now_s=12.0)} <= {*SENIORS}
    assert {*next_users(crowd, 19, now_s=12.1)} <= {*OTHERS}


def test_others_are_served_if_no_senior_answers(crowd):
    fail(crowd, OTHERS[3])
    assert cycle(crowd, *OTHERS) in OTHERS


def test_a_request_precedes_the_seniors(crowd):
    crowd.request(OTHERS[5])
    fail(crowd, OTHERS[3])
    assert next_users(crowd, 1) == [OTHERS[5]]


def test_incomplete_cycles_of_a_senior_do_not_change_the_turns(crowd):
    fail(crowd, 1)
    assert sorted(next_users(crowd, 28)) == [*SENIORS, *OTHERS]


def test_three_incomplete_cycles_in_a_row_end_the_rank_of_a_senior(crowd):
    for _ in range(2):
        fail(crowd, 1)
        fail(crowd, 1)
        fail(crowd, OTHERS[0])
        assert 1 in next_users(crowd, 8)
    for _ in range(3):
        fail(crowd, 1)
    fail(crowd, OTHERS[0])
    assert {*next_users(crowd, 8)} == {*SENIORS[1:]}


def test_a_senior_that_has_left_keeps_its_place_until_another_user_is_served(crowd):
    crowd.remove(1)
    crowd.register(1)
    fail(crowd, OTHERS[0])
    assert 1 in next_users(crowd, 8)
    crowd.remove(1)
    crowd.end_cycle(OTHERS[0], 12.0, 12.1, completed=True)
    fail(crowd, OTHERS[1])
    assert {*next_users(crowd, 8)} == {*SENIORS[1:], OTHERS[0]}


# The nodes that own the numbers

FIRST, SECOND = 1_700_000_000 * 10**9, 1_800_000_000 * 10**9
SILENT = 10.0 + SILENT_S


@pytest.fixture
def instances(make):
    """A registry with a user whose node is known."""
    result = make()
    assert result.register(2, FIRST, 10.0) == ''
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
        instances.register(2, FIRST, now_s)
    assert instances.owner(2) == FIRST


def test_the_next_owner_has_the_rights_of_the_first(instances):
    for _ in range(3):
        instances.reject(2)
    assert instances.register(2, SECOND, SILENT) == ''
    assert instances.owner(2) == SECOND
    assert instances.is_taken(2, FIRST, SILENT)


def test_a_number_that_was_released_has_no_owner(instances):
    instances.remove(2)
    assert not instances.is_taken(2, SECOND, 10.0)


def test_a_conflict_is_logged_once_until_it_has_ended(instances):
    instances.reject(2)
    first = instances.register(2, FIRST, 11.0)
    assert first == ('user 2: two nodes have this number; the first one, '
                     'started 2023-11-14 22:13:20 UTC, is served')
    instances.reject(2)
    assert instances.register(2, FIRST, 15.0) == ''
    assert instances.conflicts(19.0) == {'conflict.user_2': first}
    assert instances.conflicts(20.1) == {}
    instances.reject(2)
    assert instances.register(2, FIRST, 21.0) == first


# Lists of users in texts


@pytest.mark.parametrize(('text', 'users'), [
    ('', []), ('  ', []), ('3', [3]), ('1, 4,10 - 12', [1, 4, 10, 11, 12]),
    ('7-7,4294967295', [7, 4294967295])])
def test_lists_of_users_are_parsed(text, users):
    assert [user for numbers in parse_users(text) for user in numbers] == users


@pytest.mark.parametrize(('text', 'part'), [
    ('0', "'0'"), ('1,', "''"), ('1,x', "'x'"), ('5-3', "'5-3'"), ('-2', "'-2'"),
    ('1;2', "'1;2'"), ('4294967296', "'4294967296'"), ('1.5', "'1.5'")])
def test_a_malformed_part_is_an_error_that_names_it(text, part):
    with pytest.raises(ValueError, match=r'expected numbers from 1 to 4294967295') as raised:
        parse_users(text)
    assert str(raised.value).startswith(part)


@pytest.mark.parametrize(('users', 'text'), [
    ([], ''), ([4], '4'), ([4, 9], '4, 9'), (range(1, 9), '1, 2, 3, 4, 5, 6, 7, 8'),
    (range(1, 10), '1, 2, 3, 4, 5, 6, 7, 8 and 1 other'),
    (range(1, 21), '1, 2, 3, 4, 5, 6, 7, 8 and 12 others')])
def test_a_list_names_few_users_and_counts_the_others(users, text):
    assert join_users(users) == text
