"""The nodes that are present; the newest node of a role serves, and the others stand by."""

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


def test_the_older_node_stands_by_until_the_newer_is_silent(presences):
    presences.add(other(), NOW_NS, 1.0)
    assert presences.stands_by
    assert presences.conflicts() == {
        'conflict.role': 'two nodes act as bs: this one stands by for /bs, '
                         'started 2023-11-14 22:13:20 UTC'}
    presences.now_s = 1.0 + SILENCE_S - 0.01
    assert presences.stands_by
    # A clock may be ahead by less than an hour.
    presences.add(other(age_s=-3500), NOW_NS, 1.5)
    presences.now_s = 1.0 + SILENCE_S
    assert presences.stands_by
    presences.now_s = 1.5 + SILENCE_S
    assert not presences.stands_by
    assert presences.conflicts() == {}


def test_the_newer_node_serves(presences):
    presences.add(other(age_s=9), NOW_NS, 0.0)
    assert not presences.stands_by
    assert presences.conflicts() == {
        'conflict.role': 'two nodes act as bs: this one serves instead of /bs, '
                         'started 2023-11-14 22:13:11 UTC'}


@pytest.mark.parametrize(('own', 'library'), [('lib1', 'none'), ('none', 'lib1'),
                                              ('lib1', 'lib2')])
def test_a_required_role_with_another_library_is_missing_and_reported(own, library):
    presences = Presences(dataclasses.replace(OWN, library_id=own))
    presences.add(other(role='rhs_controller', node='/rhs_controller', library_id=library),
                  NOW_NS, 0.0)
    assert presences.newest('rhs_controller') == 0
    assert presences.conflicts() == {
        'conflict.library': f'/rhs_controller: library of codebooks {library}, expected {own} of '
                            'this node; set the same library_file'}
    # Of two nodes with the same role, one stands by whatever their libraries are.
    presences.add(other(library_id=library), NOW_NS, 0.0)
    assert presences.stands_by


@pytest.mark.parametrize('library', ['', 'lib1'])
def test_the_same_library_or_none_is_no_conflict(library):
    presences = Presences(dataclasses.replace(OWN, library_id='lib1'))
    presences.add(other(role='channel', library_id=library), NOW_NS, 0.0)
    assert presences.newest('channel') == NOW_NS
    assert presences.conflicts() == {}


def test_a_role_is_present_while_one_of_its_nodes_announces_it(presences):
    older, newer = (other(age_s, node='/channel', role='channel') for age_s in (2, 1))
    presences.add(older, NOW_NS, 0.0)
    presences.add(newer, NOW_NS, 1.0)
    assert presences.newest('channel') == newer.sender
    assert presences.newest('optimizer') == 0
    presences.now_s = 1.0 + SILENCE_S
    assert presences.newest('channel') == 0


def test_a_node_has_no_role_before_it_is_ready_and_after_it_has_ended(presences):
    channel = other(node='/channel', role='channel')
    for announced, expected in ((dataclasses.replace(channel, role=''), 0),
                                (channel, channel.sender),
                                (dataclasses.replace(channel, role=''), 0)):
        presences.add(announced, NOW_NS, 0.0)
        assert presences.newest('channel') == expected


def test_nodes_without_a_role_do_not_supersede():
    starting = Presences(dataclasses.replace(OWN, role=''))
    for presences in (starting, Presences(OWN)):
        presences.add(other(role=''), NOW_NS, 0.0)
        assert not presences.stands_by
        assert not presences.conflicts()
    # Nodes with another scenario are reported at once.
    starting.add(other(role='', scenario_id='sc2'), NOW_NS, 0.0)
    assert starting.conflicts()


@pytest.mark.parametrize('changes', [
    {'sender': OWN.sender}, {'role': 'channel'}, {'sender': 0}, {'sender': 2**64 - 1},
    {'sender': NOW_NS + 3700 * 10**9}])
def test_itself_other_roles_and_impossible_instances_are_no_conflict(presences, changes):
    presences.add(dataclasses.replace(other(), **changes), NOW_NS, 0.0)
    assert not presences.stands_by
    assert not presences.conflicts()


def test_another_scenario_is_named_and_neither_serves_nor_supersedes(presences):
    stranger = other(scenario_id='sc2', node='/channel', role='channel',
                     scenario='{"n_frames": 6, "n_feeds": 3}')
    presences.add(stranger, NOW_NS, 0.0)
    text = ('/channel uses another scenario, sc2, with n_frames 6 instead of 4; '
            'its messages are dropped')
    assert presences.conflicts() == {'conflict.scenario': text}
    presences.add(dataclasses.replace(stranger, sender=NOW_NS - 1, role='bs'), NOW_NS, 0.0)
    assert presences.conflicts() == {
        'conflict.scenario': text.replace('/channel', '/channel (and 1 others)')}
    assert not presences.stands_by
    assert presences.newest('channel') == 0
    presences.now_s = SILENCE_S
    assert presences.conflicts() == {}


@pytest.mark.parametrize(('own', 'theirs'), [(False, True), (True, False)])
def test_nodes_in_another_time_are_named(own, theirs):
    presences = Presences(dataclasses.replace(OWN, use_sim_time=own))
    for node in ('/user', '/channel'):
        named = other(age_s=len(node) + 1, role='', node=node, use_sim_time=theirs)
        presences.add(named, NOW_NS, 0.0)
    presences.add(other(role='', node='/alike', use_sim_time=own), NOW_NS, 0.0)
    assert presences.conflicts() == {
        'conflict.clock': f'/channel, /user: use_sim_time {str(theirs).lower()}, expected the '
                          'value of this node'}


@pytest.mark.parametrize(('scenario', 'differences'), [
    (r'{"n_frames": "\ud800", "other": 1}',
     r'n_frames "\ud800" instead of 4; n_feeds null instead of 3'),
    *((invalid, 'unknown differences') for invalid in (
        '', '[', '3', 'a: b: c', '[' * 100_000, '{"n_frames": 4, "n_feeds": 3}'))])
def test_any_text_describes_another_scenario(presences, scenario, differences):
    presences.add(other(scenario_id='sc2', scenario=scenario), NOW_NS, 0.0)
    text = presences.conflicts()['conflict.scenario']
    assert f'another scenario, sc2, with {differences}; its' in text
    assert text.encode().isascii()


def test_forged_announcements_fill_neither_the_memory_nor_the_diagnostics(presences):
    for number in range(1000):
        presences.add(other(scenario_id=f'sc{number}x', age_s=number), NOW_NS, 0.0)
    assert len(presences._known) == 64
    assert [*presences.conflicts()] == ['conflict.scenario']
