"""Whom the base station knows, waits for and serves."""

import numpy as np
import pytest

from rhs_isac_ros.protocol.user_scheduler import POLICIES, UserScheduler


@pytest.fixture
def roster():
    def make(policy='round_robin', seed=0):
        return UserScheduler(policy, np.random.default_rng(seed))
    return make


def cycle(roster, *users):
    """One cycle in which these users answer, in this order."""
    roster.open()
    for user in users:
        roster.answer(user)
    roster.give_up()
    return roster.select()


def test_policies_are_the_three():
    assert set(POLICIES) == {'round_robin', 'first', 'random'}


def test_another_policy_is_an_error(roster):
    with pytest.raises(ValueError, match=r"policy: 'last', expected one of \['round_robin'"):
        roster('last')


def test_round_robin_serves_who_was_served_longest_ago(roster):
    r = roster()
    assert [cycle(r, 3, 1, 2) for _ in range(6)] == [1, 2, 3, 1, 2, 3]
    assert cycle(r, 2, 3) == 2
    assert [cycle(r, 1, 2, 3) for _ in range(4)] == [1, 3, 2, 1]


def test_round_robin_puts_a_new_user_behind_those_that_wait(roster):
    r = roster()
    assert [cycle(r, 2, 3) for _ in range(5)] == [2, 3, 2, 3, 2]
    # User 3 waits, user 2 was served just now; of newcomers the lower number comes first.
    assert [cycle(r, 1, 2, 3, 9) for _ in range(8)] == [3, 1, 9, 2, 3, 1, 9, 2]


def test_who_comes_and_goes_is_not_served_more_often_than_the_others(roster):
    r = roster()
    served = [cycle(r, 1, 2, 3)]
    for n in range(40):
        if n % 2:
            r.forget(1)
        served.append(cycle(r, 1, 2, 3))
    counts = [served.count(user) for user in (1, 2, 3)]
    assert max(counts) <= 21
    assert min(counts) >= 9


@pytest.mark.parametrize('order', [(1, 2, 3), (3, 2, 1)])
def test_nobody_waits_longer_than_a_round_for_one_that_is_gone_in_each_of_its_cycles(
        roster, order):
    r = roster()
    served = []
    for _ in range(30):
        served.append(cycle(r, *order))
        if served[-1] == 1:
            r.forget(1)
    for user in (2, 3):
        turns = [n for n, other in enumerate(served) if other == user]
        assert max(np.diff([-1, *turns])) <= 3


def test_first_serves_who_answers_first(roster):
    r = roster('first')
    assert [cycle(r, 3, 1, 2), cycle(r, 2, 3), cycle(r, 2, 1)] == [3, 2, 2]


def test_random_serves_each_as_often_and_repeats_with_its_seed(roster):
    r = roster('random')
    served = [cycle(r, 1, 2, 3) for _ in range(3000)]
    for user in (1, 2, 3):
        assert 900 < served.count(user) < 1100
    again, other = roster('random'), roster('random', seed=1)
    assert [cycle(again, 1, 2, 3) for _ in range(20)] == served[:20]
    assert [cycle(other, 1, 2, 3) for _ in range(20)] != served[:20]


def test_random_serves_only_who_answered(roster):
    r = roster('random')
    cycle(r, 1, 2, 3)
    assert {cycle(r, 2, 3) for _ in range(50)} == {2, 3}


def test_who_comes_back_has_not_waited_meanwhile(roster):
    r = roster()
    assert [cycle(r, 2, 3, 9) for _ in range(3)] == [2, 3, 9]
    r.forget(9)
    assert [cycle(r, 2, 3) for _ in range(4)] == [2, 3, 2, 3]
    assert [cycle(r, 2, 3, 9) for _ in range(3)] == [2, 9, 3]


def test_a_cycle_begins_without_answers(roster):
    r = roster()
    cycle(r, 1, 2)
    assert r.answered == [1, 2]
    r.open()
    assert r.answered == []


def test_an_empty_roster_waits_for_nobody(roster):
    r = roster()
    r.open()
    assert r.complete_with(5)


@pytest.mark.parametrize('policy', ['round_robin', 'random'])
def test_the_selection_waits_for_all_that_are_known(roster, policy):
    r = roster(policy)
    cycle(r, 1, 2, 3)
    r.open()
    assert not r.complete_with(1)
    r.answer(1)
    assert not r.complete_with(4)
    assert not r.complete_with(2)
    r.answer(2)
    assert not r.complete_with(1)
    assert r.complete_with(3)


def test_first_waits_for_nobody(roster):
    r = roster('first')
    cycle(r, 1, 2, 3)
    r.open()
    assert r.complete_with(2)


def test_who_leaves_three_beacons_unanswered_is_not_waited_for(roster):
    r = roster()
    cycle(r, 1, 2)
    for _ in range(3):
        r.open()
        assert not r.complete_with(1)
        r.answer(1)
        r.give_up()
        r.select()
    r.open()
    assert r.complete_with(1)


def test_an_answer_forgives_what_was_missed(roster):
    r = roster()
    cycle(r, 1, 2)
    for _ in range(2):
        cycle(r, 1)
    cycle(r, 1, 2)
    for _ in range(3):
        r.open()
        assert not r.complete_with(1)
        r.answer(1)
        r.give_up()
        r.select()


def test_who_is_forgotten_is_not_waited_for_until_it_answers(roster):
    r = roster()
    cycle(r, 1, 2)
    r.forget(2)
    r.open()
    assert r.complete_with(1)
    r.answer(1)
    r.answer(2)
    r.give_up()
    r.select()
    r.open()
    assert not r.complete_with(1)


def test_who_is_welcome_is_waited_for_but_has_not_answered(roster):
    r = roster()
    cycle(r, 1)
    r.welcome(2)
    assert r.answered == [1]
    r.open()
    assert not r.complete_with(1)
    r.answer(1)
    r.give_up()
    assert r.select() == 1
    assert cycle(r, 1, 2) == 2


def test_being_welcome_again_does_not_change_the_turn(roster):
    r = roster()
    cycle(r, 1, 2)
    cycle(r, 1, 2)
    r.welcome(1)
    r.welcome(2)
    assert cycle(r, 2, 1) == 1


def test_more_users_than_it_can_remember_are_refused(roster):
    roster = roster()
    roster.open()
    for user in range(1, 1025):
        assert not roster.is_full_for(user)
        roster.answer(user)
    assert roster.is_full_for(5000)
    assert not roster.is_full_for(17)
    roster.forget(17)
    assert not roster.is_full_for(5000)


def test_another_policy_goes_on_from_the_turns_so_far(roster):
    r = roster()
    cycle(r, 1, 2, 3)
    cycle(r, 1, 2, 3)
    r.follow('first')
    assert cycle(r, 2, 1, 3) == 2
    r.follow('round_robin')
    assert cycle(r, 1, 2, 3) == 3
    with pytest.raises(ValueError, match="policy: 'best', expected one of"):
        r.follow('best')
    assert cycle(r, 3, 2, 1) == 1
