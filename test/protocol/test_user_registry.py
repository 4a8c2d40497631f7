"""Users that the base station waits for and serves, and the nodes that have their numbers."""

import numpy as np
import pytest

from rhs_isac_ros.protocol.messages import LAST_USER
from rhs_isac_ros.protocol.user_registry import POLICIES, SILENT_S, UserRegistry

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


def after(registry, steps):
    """Return the users served by steps.

    A step is a cycle with users that answer, a user that is registered (+) or removed (-), or a
    new policy.
    """
    served = []
    for step in steps:
        match step:
            case tuple():
                served.append(cycle(registry, *step))
            case str():
                registry.policy = step
            case _ if step > 0:
                registry.register(step)
            case _:
                registry.remove(-step)
    return served


@pytest.mark.parametrize(('policy', 'steps', 'served'), [
    # The user served longest ago.
    ('round_robin', [(3, 1, 2)] * 6 + [(2, 3)] + [(1, 2, 3)] * 4,
     [1, 2, 3, 1, 2, 3, 2, 1, 3, 2, 1]),
    # New users follow those that wait, the lower number first; user 2 was served last.
    ('round_robin', [(2, 3)] * 5 + [(1, 2, 3, 9)] * 8, [2, 3, 2, 3, 2, 3, 1, 9, 2, 3, 1, 9, 2]),
    # A returning user has no priority.
    ('round_robin', [(2, 3, 9)] * 3 + [-9] + [(2, 3)] * 4 + [(2, 3, 9)] * 3,
     [2, 3, 9, 2, 3, 2, 3, 2, 9, 3]),
    # A registered user is waited for, but has not answered; registering again changes nothing.
    ('round_robin', [(1,), 2, (1,), (1, 2)], [1, 1, 2]),
    ('round_robin', [(1, 2), (1, 2), 1, 2, (2, 1)], [1, 2, 1]),
    # The first to answer.
    ('first', [(3, 1, 2), (2, 3), (2, 1)], [3, 2, 2]),
    # A new policy keeps the order.
    ('round_robin', [(1, 2, 3), (1, 2, 3), 'first', (2, 1, 3), 'round_robin', (1, 2, 3)],
     [1, 2, 2, 3])])
def test_the_policy_selects_among_the_users_that_answered(make, policy, steps, served):
    assert after(make(policy), steps) == served


@pytest.mark.parametrize(('policies', 'steps', 'answered', 'last', 'is_complete'), [
    # Without registered users, one answer is enough.
    (POLICIES, [], (), 5, True),
    # Otherwise, those of all registered users are needed, except by the policy `first`.
    (('round_robin', 'random'), [(1, 2, 3)], (), 1, False),
    (('round_robin', 'random'), [(1, 2, 3)], (1,), 4, False),
    (('round_robin', 'random'), [(1, 2, 3)], (1,), 2, False),
    (('round_robin', 'random'), [(1, 2, 3)], (1, 2), 1, False),
    (('round_robin', 'random'), [(1, 2, 3)], (1, 2), 3, True),
    (('first',), [(1, 2, 3)], (), 2, True),
    # A user is removed after three missed beacons in a row.
    (('round_robin',), [(1, 2), (1,), (1,)], (), 1, False),
    (('round_robin',), [(1, 2), (1,), (1,), (1,)], (), 1, True),
    (('round_robin',), [(1, 2), (1,), (1,), (1, 2), (1,), (1,)], (), 1, False),
    # A removed user is not waited for until it answers.
    (('round_robin',), [(1, 2), -2], (), 1, True),
    (('round_robin',), [(1, 2), -2, (1, 2)], (), 1, False),
    (('round_robin',), [(1,), 2], (), 1, False)])
def test_the_selection_waits_for_registered_users(
        make, policies, steps, answered, last, is_complete):
    for policy in policies:
        registry = make(policy)
        after(registry, steps)
        registry.invite(0)
        for user in answered:
            registry.add_answer(user)
        assert list(registry.answered) == list(answered)
        assert registry.is_complete_with(last) == is_complete


def test_random_is_uniform_and_reproducible(make):
    registry = make('random')
    served = [cycle(registry, 1, 2, 3) for _ in range(3000)]
    for user in (1, 2, 3):
        assert 900 < served.count(user) < 1100
    assert {cycle(registry, 2, 3) for _ in range(50)} == {2, 3}
    again, other = make('random'), make('random', seed=1)
    assert [cycle(again, 1, 2, 3) for _ in range(20)] == served[:20]
    assert [cycle(other, 1, 2, 3) for _ in range(20)] != served[:20]


def served_in_order(registry, present, n):
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
    assert (ranges[0][0], ranges[-1][1]) == (1, LAST_USER)
    assert all(first == last + 1 for (_, last), (first, _)
               in zip(ranges, ranges[1:], strict=False))


@pytest.mark.parametrize('present', [range(1, 301), range(5, 5000, 37)], ids=['dense', 'sparse'])
def test_no_user_waits_longer_than_a_round(make, present):
    registry = make()
    n = len(present)
    served_in_order(registry, present, 1)
    served = served_in_order(registry, present, 3 * n)
    for user in present:
        turns = [turn for turn, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns, 3 * n])) <= n


def test_a_user_that_is_always_late_does_not_delay_the_users_of_other_ranges(make):
    registry, late, others = make(), 3, [user for user in range(1, 41) if user != 3]
    for user in (late, *others):
        registry.register(user)
    served = []
    for _ in range(3 * len(others)):
        served += served_in_order(registry, others, 1)
        # Its acks arrive after the grant.
        registry.register(late)
    for user in others:
        turns = [turn for turn, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns, len(served)])) <= len(others) + 1


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


def test_seniors_are_served_first_for_as_long_as_the_cycle_of_another_user_took(crowd):
    # That of a senior changes nothing.
    fail(crowd, 1)
    assert sorted(next_users(crowd, 28)) == [*SENIORS, *OTHERS]
    fail(crowd, OTHERS[3])
    assert cycle(crowd, *OTHERS) in OTHERS
    assert {*next_users(crowd, 10, now_s=11.9)} == {*SENIORS}
    assert {*next_users(crowd, 1, now_s=12.0)} <= {*SENIORS}
    assert {*next_users(crowd, 19, now_s=12.1)} <= {*OTHERS}
    crowd.request(OTHERS[5])
    fail(crowd, OTHERS[3])
    assert next_users(crowd, 1) == [OTHERS[5]]


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


@pytest.fixture
def instances(make):
    """A registry with a user whose node is known."""
    result = make()
    assert result.register(2, FIRST, 10.0) == ''
    return result


def test_a_number_belongs_to_the_first_node_until_it_has_missed_three_beacons_and_a_second(
        instances):
    for now_s in range(20, 30):
        instances.reject(2)
        instances.reject(2)
        for other in (SECOND, FIRST - 1, 0):
            assert instances.is_taken(2, other, now_s)
        # The owner answers in between.
        assert not instances.is_taken(2, FIRST, now_s)
        instances.register(2, FIRST, now_s)
    for _ in range(3):
        assert instances.is_taken(2, SECOND, 1000.0)
        instances.reject(2)
    assert instances.is_taken(2, SECOND, 29.0 + SILENT_S - 0.01)
    assert not instances.is_taken(2, SECOND, 29.0 + SILENT_S)
    assert instances.owner(2) == FIRST
    assert instances.register(2, SECOND, 31.0) == ''
    assert instances.owner(2) == SECOND
    assert instances.is_taken(2, FIRST, 31.0)
    instances.remove(2)
    assert not instances.is_taken(2, FIRST, 31.0)
    assert instances.owner(2) == 0


def test_a_conflict_is_logged_once_until_it_has_ended(instances):
    instances.reject(2)
    first = instances.register(2, FIRST, 11.0)
    assert first == ('user 2: two nodes have this number; the first one, '
                     'started 2023-11-14 22:13:20 UTC, is served')
    instances.reject(2)
    assert instances.register(2, FIRST, 15.0) == ''
    assert instances.conflicts(19.0) == {'conflict.user_2': first}
    assert instances.conflicts(20.0) == {}
    instances.reject(2)
    assert instances.register(2, FIRST, 21.0) == first


def test_conflicts_with_one_node_are_one_text(instances):
    for number in range(3, 403):
        instances.register(number, FIRST, 10.0)
        instances.reject(number)
        instances.register(number, FIRST, 11.0)
    instances.register(500, SECOND, 10.0)
    instances.reject(500)
    instances.register(500, SECOND, 11.0)
    texts = instances.conflicts(12.0)
    assert texts.keys() == {'conflict.user_3', 'conflict.user_500'}
    assert texts['conflict.user_3'].startswith(
        'users 3, 4, 5, 6, 7, 8, 9, 10 and 392 others: two nodes have these numbers; the first')
    assert texts['conflict.user_500'].startswith('user 500: two nodes have this number')
