"""Users that the base station waits for and serves."""

import numpy as np
import pytest

from rhs_isac_ros.protocol.user_scheduler import POLICIES, UserScheduler


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
    assert scheduler.answered == [1, 2]
    scheduler.begin_cycle()
    assert scheduler.answered == []


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
    assert scheduler.answered == [1]
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


def test_the_number_of_registered_users_is_limited(make):
    scheduler = make()
    scheduler.begin_cycle()
    for user in range(1, 1025):
        assert not scheduler.is_full_for(user)
        scheduler.add_answer(user)
    assert scheduler.is_full_for(5000)
    assert not scheduler.is_full_for(17)
    scheduler.remove(17)
    assert not scheduler.is_full_for(5000)


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
