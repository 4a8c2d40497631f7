"""The newest node of a role serves; the others stand by until it has gone."""

import dataclasses

import pytest

from rhs_isac_ros.protocol.presences import SILENCE_S, Presence, Presences

NOW_NS = 1_700_000_000 * 10**9
OWN = Presence(NOW_NS - 5 * 10**9, 'sc1', 'bs', '/bs', '{"n_frames": 4, "n_feeds": 3}')


def other(age_s=0, **changes):
    return dataclasses.replace(OWN, sender=NOW_NS - int(age_s * 1e9), **changes)


@pytest.fixture
def presences():
    return Presences(OWN)


def texts(messages):
    return [message.text for message in messages]


def test_a_node_serves_alone(presences):
    assert presences.add(OWN, NOW_NS, 0.0) == []
    assert presences.update(0.0) == []
    assert not presences.stands_by
    assert presences.rival == 0
    assert not presences.has_conflicts
    assert presences.conflicts() == {}


def test_the_older_node_stands_by_until_the_newer_is_silent(presences):
    text = 'two nodes act as bs: this one stands by for /bs, started 2023-11-14 22:13:20 UTC'
    assert texts(presences.add(other(), NOW_NS, 0.0)) == [text]
    assert presences.stands_by
    assert presences.conflicts() == {
        'conflict.role': 'stands by for /bs, started 2023-11-14 22:13:20 UTC'}
    assert presences.add(other(), NOW_NS, 1.0) == []
    assert presences.update(1.0 + SILENCE_S - 0.01) == []
    assert presences.stands_by
    assert texts(presences.update(1.0 + SILENCE_S)) == [
        '/bs has gone; this node acts as bs again']
    assert not presences.stands_by
    assert not presences.has_conflicts


def test_the_newer_node_serves(presences):
    (message,) = presences.add(other(age_s=9), NOW_NS, 0.0)
    assert message.warning
    assert message.text == (
        'two nodes act as bs: this one serves instead of /bs, started 2023-11-14 22:13:11 UTC')
    assert not presences.stands_by
    assert presences.has_conflicts
    assert 'serves instead of' in presences.conflicts()['conflict.role']
    assert presences.update(SILENCE_S) == []
    assert presences.conflicts() == {}
    # It was only suspended.
    assert presences.add(other(age_s=9), NOW_NS, 9.0) == []
    assert 'serves instead of' in presences.conflicts()['conflict.role']


def test_the_newest_of_three_serves_although_all_have_one_name(presences):
    for age_s, now_s in ((1, 0.0), (9, 0.5), (0, 0.1)):
        presences.add(other(age_s), NOW_NS, now_s)
    assert presences.conflicts()['conflict.role'].endswith('22:13:20 UTC')
    presences.add(other(age_s=1), NOW_NS, 1.0)
    assert texts(presences.update(0.1 + SILENCE_S)) == [
        'two nodes act as bs: this one stands by for /bs, started 2023-11-14 22:13:19 UTC']


def test_a_name_is_silent_if_none_of_its_instances_announces_itself(presences):
    presences.add(other(age_s=2, node='/channel', role='channel'), NOW_NS, 0.0)
    presences.add(other(age_s=1, node='/optimizer', role='optimizer'), NOW_NS, 0.0)
    presences.update(1.0)
    assert presences.silent() == set()
    presences.add(other(age_s=0, node='/channel', role='channel'), NOW_NS, 1.5)
    presences.update(2.0)
    assert presences.silent() == {'/optimizer'}
    presences.update(1.5 + SILENCE_S)
    assert presences.silent() == {'/optimizer', '/channel'}


def test_a_restarted_node_is_silent_until_it_has_a_role(presences):
    presences.add(other(age_s=2, node='/channel', role='channel'), NOW_NS, 0.0)
    presences.add(other(node='/channel', role=''), NOW_NS, 2.0)
    assert presences.silent() == {'/channel'}
    presences.add(other(node='/channel', role='channel'), NOW_NS, 2.1)
    assert presences.silent() == set()
    # A node that starts for the first time has no predecessor.
    presences.add(other(age_s=1, node='/optimizer', role=''), NOW_NS, 2.1)
    assert presences.silent() == set()


def test_nodes_without_a_role_do_not_supersede():
    starting = Presences(dataclasses.replace(OWN, role=''))
    for presences in (starting, Presences(OWN)):
        assert presences.add(other(role=''), NOW_NS, 0.0) == []
        assert not presences.stands_by
    # Nodes with another scenario are reported at once.
    assert starting.add(other(role='', scenario_id='sc2'), NOW_NS, 0.0)


def test_exactly_one_of_several_nodes_serves():
    all_of_them = [other(age_s=age_s) for age_s in range(4)]
    serving = []
    for own in all_of_them:
        presences = Presences(own)
        for announced in all_of_them:
            presences.add(announced, NOW_NS, 0.0)
        serving += [] if presences.stands_by else [own]
    assert serving == [all_of_them[0]]


def test_a_clock_may_be_ahead_by_less_than_an_hour(presences):
    assert presences.add(
        dataclasses.replace(other(), sender=NOW_NS + 3500 * 10**9), NOW_NS, 0.0)
    assert presences.stands_by


@pytest.mark.parametrize('changes', [
    {'role': 'channel'}, {'sender': 0}, {'sender': NOW_NS + 3700 * 10**9},
    {'sender': 2**64 - 1}])
def test_other_roles_and_impossible_instances_are_ignored(presences, changes):
    assert presences.add(dataclasses.replace(other(), **changes), NOW_NS, 0.0) == []
    assert not presences.has_conflicts


def test_another_scenario_is_named_once_and_never_supersedes(presences):
    stranger = other(scenario_id='sc2', node='/channel', role='channel',
                     scenario='{"n_frames": 6, "n_feeds": 3}')
    (message,) = presences.add(stranger, NOW_NS, 0.0)
    assert message.warning
    assert message.text == ('/channel uses another scenario, sc2, with n_frames 6 instead of 4; '
                            'its messages are dropped')
    assert presences.conflicts() == {'conflict.sc2': message.text}
    same_role = dataclasses.replace(stranger, sender=NOW_NS - 1, role='bs')
    assert presences.add(same_role, NOW_NS, 0.0) == []
    assert not presences.stands_by
    assert texts(presences.update(SILENCE_S)) == ['no node with scenario sc2 is left']
    assert presences.conflicts() == {}


@pytest.mark.parametrize(('scenario', 'differences'), [
    (r'{"n_frames": "\ud800", "other": 1}',
     r'n_frames "\ud800" instead of 4; n_feeds null instead of 3'),
    *((invalid, 'unknown differences') for invalid in (
        '', '[', '3', 'a: b: c', '[' * 100_000, '{"n_frames": 4, "n_feeds": 3}'))])
def test_any_text_describes_another_scenario(presences, scenario, differences):
    (message,) = presences.add(other(scenario_id='sc2', scenario=scenario), NOW_NS, 0.0)
    assert f'another scenario, sc2, with {differences}; its' in message.text
    assert message.text.encode().isascii()


def test_forged_announcements_fill_neither_the_memory_nor_the_log(presences):
    logged = []
    for number in range(1000):
        logged += presences.add(
            other(scenario_id=f'sc{number}x', age_s=number), NOW_NS, 0.0)
    assert len(logged) == 16
    assert len(presences._known) == 64
    assert len(presences.conflicts()) == 64
