"""Users that the base station waits for and serves."""

import numpy as np
import pytest

from rhs_isac_ros.protocol.base_station_memory import (
    INVITED,
    LAST_NUMBER,
    POLICIES,
    UserScheduler,
)


@pytest.fixture
def make():
    """Function that returns a scheduler."""
    def build(policy='round_robin', seed=0):
        return UserScheduler(policy, np.random.default_rng(seed))
    return build


def cycle(scheduler, *users):
    """Return the user served in a cycle in which these users answer, in this order."""
    scheduler.begin_cycle()
    for user in users:
        scheduler.add_answer(user)
    scheduler.remove_absent()
    return scheduler.select()


def test_there_are_three_policies():
    assert set(POLICIES) == {'round_robin', 'first', 'random'}


def test_an_unknown_policy_is_an_error(make):
    with pytest.raises(ValueError, match=r"policy: 'last', expected one of \['round_robin'"):
        make('last')


def test_round_robin_serves_the_user_served_longest_ago(make):
    scheduler = make()
    assert [cycle(scheduler, 3, 1, 2) for _ in range(6)] == [1, 2, 3, 1, 2, 3]
    assert cycle(scheduler, 2, 3) == 2
    assert [cycle(scheduler, 1, 2, 3) for _ in range(4)] == [1, 3, 2, 1]


def test_round_robin_serves_a_new_user_after_those_that_wait(make):
    scheduler = make()
    assert [cycle(scheduler, 2, 3) for _ in range(5)] == [2, 3, 2, 3, 2]
    # User 3 waits, user 2 was served last; of new users the lower number comes first.
    assert [cycle(scheduler, 1, 2, 3, 9) for _ in range(8)] == [3, 1, 9, 2, 3, 1, 9, 2]


def test_a_user_that_leaves_and_returns_is_not_served_more_often(make):
    scheduler = make()
    served = [cycle(scheduler, 1, 2, 3)]
    for n in range(40):
        if n % 2:
            scheduler.remove(1)
        served.append(cycle(scheduler, 1, 2, 3))
    counts = [served.count(user) for user in (1, 2, 3)]
    assert max(counts) <= 21
    assert min(counts) >= 9


@pytest.mark.parametrize('order', [(1, 2, 3), (3, 2, 1)])
def test_a_user_lost_in_each_of_its_cycles_delays_the_others_by_at_most_one_turn(
        make, order):
    scheduler = make()
    served = []
    for _ in range(30):
        served.append(cycle(scheduler, *order))
        if served[-1] == 1:
            scheduler.remove(1)
    for user in (2, 3):
        turns = [n for n, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns])) <= 3


def test_first_serves_the_first_to_answer(make):
    scheduler = make('first')
    assert [cycle(scheduler, 3, 1, 2), cycle(scheduler, 2, 3), cycle(scheduler, 2, 1)] == [3, 2, 2]


def test_random_is_uniform_and_reproducible(make):
    scheduler = make('random')
    served = [cycle(scheduler, 1, 2, 3) for _ in range(3000)]
    for user in (1, 2, 3):
        assert 900 < served.count(user) < 1100
    again, other = make('random'), make('random', seed=1)
    assert [cycle(again, 1, 2, 3) for _ in range(20)] == served[:20]
    assert [cycle(other, 1, 2, 3) for _ in range(20)] != served[:20]


def test_random_serves_only_users_that_answered(make):
    scheduler = make('random')
    cycle(scheduler, 1, 2, 3)
    assert {cycle(scheduler, 2, 3) for _ in range(50)} == {2, 3}


def test_a_returning_user_has_no_priority(make):
    scheduler = make()
    assert [cycle(scheduler, 2, 3, 9) for _ in range(3)] == [2, 3, 9]
    scheduler.remove(9)
    assert [cycle(scheduler, 2, 3) for _ in range(4)] == [2, 3, 2, 3]
    assert [cycle(scheduler, 2, 3, 9) for _ in range(3)] == [2, 9, 3]


def test_a_cycle_begins_without_answers(make):
    scheduler = make()
    cycle(scheduler, 1, 2)
    assert list(scheduler.answered) == [1, 2]
    scheduler.begin_cycle()
    assert not scheduler.answered


def test_without_registered_users_one_answer_is_enough(make):
    scheduler = make()
    scheduler.begin_cycle()
    assert scheduler.is_complete_with(5)


@pytest.mark.parametrize('policy', ['round_robin', 'random'])
def test_the_selection_waits_for_all_registered_users(make, policy):
    scheduler = make(policy)
    cycle(scheduler, 1, 2, 3)
    scheduler.begin_cycle()
    assert not scheduler.is_complete_with(1)
    scheduler.add_answer(1)
    assert not scheduler.is_complete_with(4)
    assert not scheduler.is_complete_with(2)
    scheduler.add_answer(2)
    assert not scheduler.is_complete_with(1)
    assert scheduler.is_complete_with(3)


def test_first_needs_one_answer_only(make):
    scheduler = make('first')
    cycle(scheduler, 1, 2, 3)
    scheduler.begin_cycle()
    assert scheduler.is_complete_with(2)


def test_a_user_is_removed_after_three_missed_beacons(make):
    scheduler = make()
    cycle(scheduler, 1, 2)
    for _ in range(3):
        scheduler.begin_cycle()
        assert not scheduler.is_complete_with(1)
        scheduler.add_answer(1)
        scheduler.remove_absent()
        scheduler.select()
    scheduler.begin_cycle()
    assert scheduler.is_complete_with(1)


def test_an_answer_resets_the_count_of_missed_beacons(make):
    scheduler = make()
    cycle(scheduler, 1, 2)
    for _ in range(2):
        cycle(scheduler, 1)
    cycle(scheduler, 1, 2)
    for _ in range(3):
        scheduler.begin_cycle()
        assert not scheduler.is_complete_with(1)
        scheduler.add_answer(1)
        scheduler.remove_absent()
        scheduler.select()


def test_a_removed_user_is_not_waited_for_until_it_answers(make):
    scheduler = make()
    cycle(scheduler, 1, 2)
    scheduler.remove(2)
    scheduler.begin_cycle()
    assert scheduler.is_complete_with(1)
    scheduler.add_answer(1)
    scheduler.add_answer(2)
    scheduler.remove_absent()
    scheduler.select()
    scheduler.begin_cycle()
    assert not scheduler.is_complete_with(1)


def test_a_registered_user_is_waited_for_but_has_not_answered(make):
    scheduler = make()
    cycle(scheduler, 1)
    scheduler.register(2)
    assert list(scheduler.answered) == [1]
    scheduler.begin_cycle()
    assert not scheduler.is_complete_with(1)
    scheduler.add_answer(1)
    scheduler.remove_absent()
    assert scheduler.select() == 1
    assert cycle(scheduler, 1, 2) == 2


def test_registering_again_does_not_change_the_turn(make):
    scheduler = make()
    cycle(scheduler, 1, 2)
    cycle(scheduler, 1, 2)
    scheduler.register(1)
    scheduler.register(2)
    assert cycle(scheduler, 2, 1) == 1


def test_a_new_policy_keeps_the_turns(make):
    scheduler = make()
    cycle(scheduler, 1, 2, 3)
    cycle(scheduler, 1, 2, 3)
    scheduler.set_policy('first')
    assert cycle(scheduler, 2, 1, 3) == 2
    scheduler.set_policy('round_robin')
    assert cycle(scheduler, 1, 2, 3) == 3
    with pytest.raises(ValueError, match="policy: 'best', expected one of"):
        scheduler.set_policy('best')
    assert cycle(scheduler, 3, 2, 1) == 1


def served_in_turn(scheduler, present, n):
    """Return the users served in cycles in which the invited ones of `present` answer."""
    served = []
    for _ in range(n):
        scheduler.begin_cycle()
        answering, attempt = [], 0
        while not answering:
            first, last = scheduler.invite(attempt)
            answering = [user for user in present if first <= user <= last]
            if not answering:
                assert not scheduler.all_invited
                scheduler.remove_absent()
                attempt += 1
        for user in answering:
            scheduler.add_answer(user)
        scheduler.remove_absent()
        served.append(scheduler.select())
    return served


@pytest.mark.parametrize('n', [0, 1, INVITED])
def test_few_users_are_invited_together(make, n):
    scheduler = make()
    for user in range(1, n + 1):
        scheduler.register(3 * user)
    assert scheduler.invite(0) == (1, LAST_NUMBER)
    assert scheduler.all_invited


@pytest.mark.parametrize('policy', POLICIES)
def test_of_many_users_few_are_invited(make, policy):
    scheduler, numbers = make(policy), [7 * n for n in range(1, 101)]
    for user in numbers:
        scheduler.register(user)
    ranges = set()
    for _ in range(400):
        scheduler.begin_cycle()
        first, last = scheduler.invite(0)
        ranges.add((first, last))
        invited = [user for user in numbers if first <= user <= last]
        assert 1 <= len(invited) <= INVITED
        for user in invited:
            assert scheduler.is_complete_with(0) is (policy == 'first')
            scheduler.add_answer(user)
        assert scheduler.is_complete_with(0)
        scheduler.select()
    # Together, the ranges contain every number once.
    ranges = sorted(ranges)
    assert (ranges[0][0], ranges[-1][1]) == (1, LAST_NUMBER)
    assert all(first == last + 1 for (_, last), (first, _)
               in zip(ranges, ranges[1:], strict=False))


@pytest.mark.parametrize('present', [range(1, 1001), range(5, 5000, 37)], ids=['dense', 'sparse'])
def test_no_user_waits_longer_than_a_round(make, present):
    scheduler = make()
    n = len(present)
    served_in_turn(scheduler, present, 1)
    served = served_in_turn(scheduler, present, 3 * n)
    for user in present:
        turns = [turn for turn, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns, 3 * n])) <= n


def test_a_user_that_is_always_late_does_not_delay_the_users_of_other_ranges(make):
    scheduler, late, others = make(), 3, [user for user in range(1, 41) if user != 3]
    for user in (late, *others):
        scheduler.register(user)
    served = []
    for _ in range(3 * len(others)):
        served += served_in_turn(scheduler, others, 1)
        # Its acks arrive after the grant.
        scheduler.register(late)
    for user in others:
        turns = [turn for turn, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns, len(served)])) <= len(others) + 1


def test_new_users_between_many_are_served_within_two_rounds(make):
    scheduler = make()
    served_in_turn(scheduler, range(2, 202, 2), 100)
    served = served_in_turn(scheduler, range(1, 211), 210 + 100)
    assert set(served) == {*range(1, 211)}


def test_users_that_leave_together_delay_the_others_by_few_beacons(make):
    scheduler = make()
    served_in_turn(scheduler, range(1, 1001), 300)
    served = served_in_turn(scheduler, range(501, 1001), 600)
    assert scheduler.n_users == 500
    assert set(served) == {*range(501, 1001)}


def test_only_invited_users_miss_a_beacon(make):
    scheduler = make()
    served_in_turn(scheduler, range(1, 101), 100)
    for _ in range(5):
        scheduler.begin_cycle()
        scheduler.invite(0)
        scheduler.add_answer(1)
        lost = scheduler.remove_absent()
        assert set(lost) <= {*range(1, INVITED + 1)}
        scheduler.select()
    assert scheduler.n_users > 100 - 2 * INVITED
