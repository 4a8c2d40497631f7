"""The live view of an overview."""

import dataclasses
import os
import re

import numpy as np
import pytest
from in_memory_network import Network

from rhs_isac_ros.monitoring.cycle_log import RECEIVES
from rhs_isac_ros.monitoring.network_state import Overview
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.tools.watch import render

console = pytest.importorskip('rich.console', reason='rich is not installed')


def text_of(overview, now_s, width=80):
    page = console.Console(width=width, record=True, file=open(os.devnull, 'w'))
    with page.file:
        page.print(render(overview, now_s))
    return page.export_text()


def test_the_view_shows_faults_and_silent_nodes_within_80_columns(example):
    overview = Overview()
    overview.add(m.Beacon(cycle_id=1795288682616, attempt=0), 1.0)
    overview.add(example(
        m.ProtocolState, cycle_id=1795288682616, user=12, outcome='rhs_silent'), 2.0)
    overview.add(m.Beacon(cycle_id=1795288682617, attempt=0), 3.0)
    overview.add_report('lab/bs', Report(True, 'waiting for positioner', {
        'phase': 'waiting', 'dropped.late_ack': '3', 'cycles.no_fix': '2'}), 1.0)
    overview.add_report('lab/channel', Report(False, 'no fault', {}), 3.0)
    assert (overview.served, overview.given_up) == (0, 1)
    text = text_of(overview, 5.0)
    assert 'beaconing for 2.00 s, cycle 1795288682617' in text
    assert 'last given up: cycle 1795288682616 of user 12: rhs_silent' in text
    assert re.search(r'lab/bs +waiting +silent for 4 s +2 no_fix +3 late_ack', text)
    assert re.search(r'lab/channel +no fault +0 +0', text)
    assert '…' not in text


def test_users_keep_their_rows_which_fit_into_80_columns(scenario, codebooks, places):
    net = Network(scenario, codebooks[0], {user: places[user - 1] for user in (1, 2, 3)})
    net.run_cycles(5)
    overview, rows = Overview(), []
    for sent in net.log:
        if isinstance(sent.message, RECEIVES):
            overview.add(sent.message, sent.time_s)
            rows.append(re.findall(r'^ +(\d+) ', text_of(overview, sent.time_s), re.MULTILINE))
    assert rows[-1] == ['1', '2', '3']
    assert all(row == sorted(row) for row in rows)
    cycle = overview.users[1]
    far = {'position': np.array([-10.34, -12.2, 1.1]), 'outside_probability': 0.123}
    overview.users[12] = dataclasses.replace(
        cycle, estimate=dataclasses.replace(cycle.estimate, **far))
    text = text_of(overview, net.log[-1].time_s)
    assert re.search(r'^ +12 +-10.34 -12.20   1.10 +[.\d]+ +[.\d]+ +12/0 ', text, re.MULTILINE)
    assert 'out/blk: probability of being outside of the region/blocked' in text
    assert '…' not in text


def test_the_view_shows_a_pause(example):
    overview = Overview()
    assert text_of(overview, 0.0).startswith('waiting for a base station')
    paused = Report(False, 'paused', {'phase': 'paused'})
    overview.add_report('bs', paused, 1.0)
    assert text_of(overview, 2.0).startswith('paused')
    overview.add(m.Beacon(cycle_id=1, attempt=0), 3.0)
    assert text_of(overview, 4.0).startswith('beaconing for 1.00 s')
    overview.add(example(m.ProtocolState, cycle_id=1, outcome='served'), 5.0)
    overview.add_report('bs', paused, 6.0)
    assert text_of(overview, 7.0).startswith('paused for 2.00 s, cycle 1')


def test_received_strings_are_neither_markup_nor_control_sequences(example):
    overview = Overview()
    overview.add(example(m.ProtocolState, cycle_id=1, user=2, outcome='\x1b[2J[/red]'), 1.0)
    overview.add_report('a[/b]\x1b[31m', Report(True, '[bold]\n[/x]', {
        'phase': '[/', 'dropped.[/]\x07': '3', 'dropped.long': '9' * 5000}), 1.0)
    text = text_of(overview, 2.0, width=120)
    assert 'of user 2: ?[2J[/red]' in text
    assert re.search(r'a\[/b\]\?\[31m +\[/ +\[bold\]\?\[/x\] +0 +3 \[/\]\?', text)
    assert '\x1b' not in text and '\x07' not in text
