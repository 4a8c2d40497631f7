"""A sequence diagram of one cycle, from the messages that the roles exchange."""

import collections
import itertools
from types import SimpleNamespace

import numpy as np
import svg

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.frontend import Air, EmulatedRadio, EmulatedSurface, FrontEnd
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import user
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel, apply_patterns
from rhs_isac_ros.protocol.events import (
    ApplyPatterns,
    BuildEstimator,
    CodebookOffered,
    PeersChanged,
    Send,
    Timeout,
)
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.ros.roster import ROSTER
from rhs_isac_ros.ros.topics import NAMES

# Roles, in the order of the columns.
RECEIVES = {name: ROSTER[name].role.RECEIVES for name in (
    'user', 'channel', 'bs', 'rhs_controller', 'positioner', 'transmission')}
_COLUMN, _ROW, _TOP, _LEFT = 165, 24, 50, 70


def cycle():
    """Run the roles until a user is served; return pairs (sender, message) in order."""
    scenario = Scenario(n_subbands=2, n_frames=2, n_feeds=2, elements_per_side=4)
    codebook = random_codebook(scenario, np.random.default_rng(0))
    # The diagram does not depend on positions.
    centre = Estimate(np.array(scenario.roi_center_m), np.eye(3))
    estimator = SimpleNamespace(name='centre', estimate=lambda received: centre)
    roles = {
        'user': user.User(
            {1: mobility.Static(scenario.roi_center_m)}, scenario, step_s=1.0, beacon_s=3.0),
        'channel': Channel(scenario, 0),
        'rhs_controller': RhsController(), 'transmission': Transmission(scenario),
        'positioner': Positioner(scenario, lambda: 0.0),
        'bs': BaseStation(
            scenario, BaseStationSettings(policy='first'), np.random.default_rng(0), 0),
    }
    air = Air(scenario, np.random.default_rng(0))
    front_end = FrontEnd(
        EmulatedSurface(scenario.n_elements), EmulatedRadio(scenario, air), air)
    sent, queue, now_s = [], collections.deque(), 0.0

    def dispatch(name, event):
        for action in roles[name].handle(event, now_s):
            if isinstance(action, BuildEstimator):
                dispatch(name, build_estimator(
                    action.codebook, lambda codebook: estimator, lambda: 0.0))
            elif isinstance(action, ApplyPatterns):
                dispatch(name, apply_patterns(front_end, action))
            elif isinstance(action, Send):
                sent.append((name, action.message))
                queue.extend((other, action.message) for other, kinds in RECEIVES.items()
                             if other != name and type(action.message) in kinds)
    for name in ('rhs_controller', 'transmission', 'positioner', 'bs'):
        dispatch(name, CodebookOffered(codebook))
    for name in ('user', 'bs'):
        dispatch(name, PeersChanged(()))
    while not any(getattr(message, 'outcome', '') for _, message in sent):
        if queue:
            dispatch(*queue.popleft())
        else:
            now_s = roles['bs'].next_deadline()
            dispatch('bs', Timeout())
    assert sent[-1][1].outcome == 'served', sent[-1]
    return sent


def picture():
    """Return an SVG document: a column for each role, a row for each run of equal messages."""
    rows = [(sender, kind, [message for _, message in run]) for (sender, kind), run in
            itertools.groupby(cycle(), key=lambda item: (item[0], type(item[1])))]
    place = {name: _LEFT + _COLUMN * number for number, name in enumerate(RECEIVES)}
    height = _TOP + _ROW * (len(rows) + 1)
    parts = []
    for name, x in place.items():
        parts.append(svg.text(x, 25, name, 'middle', 'title'))
        parts.append(f'<line x1="{x}" x2="{x}" y1="35" y2="{height - 10}"/>')
    for y, (sender, kind, messages) in enumerate(rows, 1):
        begin, y = place[sender], _TOP + _ROW * y
        ends = [place[name] for name in _recipients(sender, messages[0])]
        parts.append(f'<circle cx="{begin}" cy="{y}" r="3"/>')
        parts += [svg.arrow([(begin, y), (end, y)]) for end in ends]
        # The label is on the side of the arrows, inside the picture.
        right = begin < max(place.values()) and (not ends or max(ends) > begin)
        parts.append(svg.text(begin + (8 if right else -8), y - 5, NAMES[kind] + _detail(messages),
                              'start' if right else 'end'))
    width = _LEFT + max(place.values())
    return svg.document('sequence', 'One cycle', width, height, parts)


def _recipients(sender, message):
    if isinstance(message, m.Data):
        delivered = 'user' if message.direction is m.Direction.DOWNLINK else 'bs'
        return ['channel' if message.stage is m.Stage.OFFERED else delivered]
    return [name for name, kinds in RECEIVES.items() if type(message) in kinds and name != sender]


def _detail(messages):
    first = messages[0]
    if isinstance(first, m.Data):
        return f' {first.direction.name.lower()}, {first.stage.name.lower()}'
    if isinstance(first, m.ProtocolState):
        return f' {first.outcome or first.phase.name.lower()}'
    band = f' band {first.band}' if hasattr(first, 'band') else ''
    return band + (f', {len(messages)} times' if len(messages) > 1 else '')
