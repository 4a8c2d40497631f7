"""The newest node of a role serves; the others stand by until it has gone."""

import dataclasses

import pytest

from rhs_isac_ros.protocol.presences import Presence, Presences

NOW_NS = 1_700_000_000 * 10**9
OWN = Presence(NOW_NS - 5 * 10**9, 'sc1', 'bs', '/bs', {'n_frames': 4, 'n_feeds': 3})


def other(age_s=0, **changes):
    return dataclasses.replace(OWN, sender=NOW_NS - int(age_s * 1e9), **changes)


@pytest.fixture
def presences():
    return Presences(OWN)


def texts(messages):
    return [message.text for message in messages]


def test_a_node_serves_alone(presences):
    assert presences.add(OWN, NOW_NS) == []
    assert presences.keep({'/bs': 1}) == []
    assert not presences.stands_by
    assert not presences.others
    assert presences.conflicts() == {}


def test_the_older_node_stands_by_until_the_newer_has_gone(presences):
    text = 'two nodes act as bs: this one stands by for /bs, started 2023-11-14 22:13:20 UTC'
    assert texts(presences.add(other(), NOW_NS)) == [text]
    assert presences.stands_by
    assert presences.conflicts() == {
        'conflict.role': 'stands by for /bs, started 2023-11-14 22:13:20 UTC'}
    assert presences.add(other(), NOW_NS) == []
    # A name that is unknown yet may be that of the other one.
    for announcing in ({'/bs': 2}, {'/bs': 1, '': 1}):
        assert presences.gone(announcing) == set()
        assert presences.keep(announcing) == []
    assert presences.stands_by
    assert presences.gone({'/bs': 1}) == {'/bs'}
    assert texts(presences.keep({'/bs': 1})) == [
        '/bs has gone; this node acts as bs again']
    assert not presences.stands_by
    assert not presences.others


def test_the_newer_node_serves(presences):
    (message,) = presences.add(other(age_s=9), NOW_NS)
    assert message.warning
    assert message.text == (
        'two nodes act as bs: this one serves instead of /bs, started 2023-11-14 22:13:11 UTC')
    assert not presences.stands_by
    assert presences.others
    assert 'serves instead of' in presences.conflicts()['conflict.role']
    assert presences.keep({'/bs': 1}) == []
    assert presences.conflicts() == {}
    # It was only suspended.
    assert presences.add(other(age_s=9), NOW_NS) == []
    assert 'serves instead of' in presences.conflicts()['conflict.role']


def test_the_newest_of_three_serves(presences):
    presences.add(other(age_s=1), NOW_NS)
    presences.add(other(age_s=9), NOW_NS)
    presences.add(other(age_s=0), NOW_NS)
    assert presences.conflicts()['conflict.role'].endswith('22:13:20 UTC')
    presences.add(other(age_s=1), NOW_NS)
    # All have the same name, so that the one that has gone is unknown.
    assert presences.keep({'/bs': 3})
    assert not presences.stands_by
    assert texts(presences.add(other(age_s=1), NOW_NS)) == [
        'two nodes act as bs: this one stands by for /bs, started 2023-11-14 22:13:19 UTC']


def test_of_nodes_with_different_names_the_one_that_has_gone_is_forgotten(presences):
    presences.add(other(age_s=1, node='/a'), NOW_NS)
    presences.add(other(age_s=0, node='/b'), NOW_NS)
    assert texts(presences.keep({'/bs': 1, '/a': 1})) == [
        'two nodes act as bs: this one stands by for /a, started 2023-11-14 22:13:19 UTC']


def test_exactly_one_of_several_nodes_serves():
    all_of_them = [other(age_s=age_s) for age_s in range(4)]
    serving = []
    for own in all_of_them:
        presences = Presences(own)
        for announced in all_of_them:
            presences.add(announced, NOW_NS)
        serving += [] if presences.stands_by else [own]
    assert serving == [all_of_them[0]]


@pytest.mark.parametrize('changes', [
    {'role': 'channel'}, {'sender': 0}, {'sender': NOW_NS + 2 * 3600 * 10**9},
    {'sender': 2**64 - 1}])
def test_other_roles_and_impossible_instances_are_ignored(presences, changes):
    assert presences.add(dataclasses.replace(other(), **changes), NOW_NS) == []
    assert not presences.others


def test_another_scenario_is_named_once_and_never_supersedes(presences):
    stranger = other(scenario_id='sc2', node='/channel', role='channel',
                     scenario={'n_frames': 6, 'n_feeds': 3})
    (message,) = presences.add(stranger, NOW_NS)
    assert message.warning
    assert message.text == ('/channel uses another scenario, sc2, with n_frames 6 instead of 4; '
                            'its messages are dropped')
    assert presences.conflicts() == {'conflict.sc2': message.text}
    same_role = dataclasses.replace(stranger, sender=NOW_NS - 1, role='bs')
    assert presences.add(same_role, NOW_NS) == []
    assert not presences.stands_by
    assert texts(presences.keep({'/bs': 1})) == ['no node with scenario sc2 is left']
    assert presences.conflicts() == {}


def test_forged_announcements_fill_neither_the_memory_nor_the_log(presences):
    logged = []
    for number in range(1000):
        logged += presences.add(
            other(scenario_id=f'sc{number}x', age_s=number), NOW_NS)
    assert len(logged) == 16
    assert len(presences._others) == 64
    assert len(presences.conflicts()) == 64
