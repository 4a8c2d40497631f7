"""The nodes that are present; the newest node of a role serves, and the others stand by."""

import dataclasses

import pytest

from rhs_isac_ros.protocol.presences import PERIOD_S, SILENCE_S, SLOW_PERIOD_S, Presence, Presences

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
    presences.add(older, NOW_NS, 1.0)
    presences.add(newer, NOW_NS, 1.0)
    assert presences.newest('channel') == newer.sender
    assert presences.newest('optimizer') == 0
    for node in (older, newer):
        presences.add(node, NOW_NS, 1.4)
    presences.now_s = 1.4 + SILENCE_S
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
    {'sender': NOW_NS + 3700 * 10**9, 'stamp_ns': NOW_NS}])
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
        'conflict.scenario': text.replace('/channel', '/channel (and 1 other)')}
    assert not presences.stands_by
    assert presences.newest('channel') == 0
    presences.now_s = SILENCE_S * SLOW_PERIOD_S / PERIOD_S
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


def announce(presences, period_s, n, start_s=0.0, ahead_s=0.0, **changes):
    """Process announcements of a channel, and return the time of the last one [s]."""
    for number in range(n):
        now_ns = NOW_NS + int((start_s + number * period_s) * 1e9)
        last_s = start_s + number * period_s
        channel = other(age_s=-ahead_s, role='channel', node='/channel',
                        stamp_ns=now_ns + int(ahead_s * 1e9))
        presences.add(dataclasses.replace(channel, **changes), now_ns, last_s)
    return last_s


@pytest.mark.parametrize('period_s', [0.1, PERIOD_S, 1.0, 3.0, SLOW_PERIOD_S])
def test_a_node_is_gone_after_four_of_its_periods_without_an_announcement(presences, period_s):
    last_s = announce(presences, period_s, 3)
    end_s = last_s + 4 * max(period_s, PERIOD_S)
    for presences.now_s in (end_s - 0.01, end_s):
        assert bool(presences.newest('channel')) == (presences.now_s < end_s)


def test_the_periods_of_nodes_without_work_grow_together_and_follow_one_that_has_work():
    nodes = {sender: Presences(dataclasses.replace(OWN, sender=NOW_NS + sender))
             for sender in range(1, 5)}
    periods_s = dict.fromkeys(nodes, PERIOD_S)
    due_s = {sender: 0.1 * sender for sender in nodes}

    def run(end_s, working=()):
        while (now_s := min(due_s.values())) < end_s:
            sender = min(due_s, key=due_s.get)
            for each in nodes.values():
                each.add(nodes[sender].own, NOW_NS + 10**9, now_s)
                # No node counts as gone while its period grows.
                assert len(each._present()) >= len(nodes) - 1 or now_s < 0.5
            periods_s[sender] = (PERIOD_S if sender in working
                                 else nodes[sender].next_period_s(periods_s[sender]))
            due_s[sender] = now_s + periods_s[sender]
    run(10.0, working=[2])
    assert max(periods_s.values()) < 2 * PERIOD_S
    run(100.0)
    assert set(periods_s.values()) == {SLOW_PERIOD_S}
    run(130.0, working=[2])
    assert max(periods_s.values()) < 2 * PERIOD_S


@pytest.mark.parametrize(('ahead_s', 'text'), [
    (7200.0, '7200 s ahead of'), (-7200.0, '7200 s behind'), (-1.6e9, '1600000000 s behind'),
    (10.0, ''), (-10.0, '')])
def test_a_node_on_a_host_with_another_time_serves_and_is_named(presences, ahead_s, text):
    announce(presences, PERIOD_S, 1, ahead_s=ahead_s)
    # The first announcement may be an old one, which the middleware has kept.
    assert presences.newest('channel') and not presences.conflicts()
    last_s = announce(presences, PERIOD_S, 2, 0.4, ahead_s)
    assert presences.conflicts() == ({
        'conflict.host_clock': f'clock of the host of /channel: {text} that of this node, '
                               'expected the same time on all hosts'} if text else {})
    # The clock is set, and the start remains as it was.
    if ahead_s < 0:
        announce(presences, PERIOD_S, 1, last_s + 0.4, sender=other(age_s=-ahead_s).sender)
        assert not presences.conflicts()


def test_announcements_that_have_waited_say_nothing_about_clocks(presences):
    for now_s in (0.0, 0.4, *([60.0] * 100)):
        presences.add(other(age_s=9, role='channel', stamp_ns=NOW_NS), NOW_NS + int(
            now_s * 1e9), min(now_s, 0.8))
    assert not presences.conflicts()


def test_simulated_times_are_not_compared_with_clocks():
    presences = Presences(dataclasses.replace(OWN, use_sim_time=True))
    for now_s in (0.0, 0.4, 0.8):
        presences.add(other(role='channel', stamp_ns=1, use_sim_time=True), NOW_NS, now_s)
    assert presences.newest('channel') and not presences.conflicts()
