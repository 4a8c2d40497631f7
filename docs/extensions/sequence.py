"""A sequence diagram of one cycle, from the messages that the roles exchange."""

import collections
import html
import itertools

import numpy as np

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import user
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.events import (
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
# The page includes the picture, so that its style must not match other pictures. The background is
# that of the theme, light or dark.
_STYLE = ('.sequence text{font:11px monospace;fill:currentColor}'
          '.sequence .role{font-weight:bold;font-size:13px}'
          '.sequence .life{stroke:currentColor;stroke-opacity:.4;stroke-dasharray:4 4}'
          '.sequence path,.sequence circle{stroke:currentColor;fill:currentColor}'
          '.sequence .label{paint-order:stroke;stroke-width:4px;'
          'stroke:var(--color-background-primary,white)}')


class _Centre:
    """Estimator that always returns the centre of the region.

    The diagram does not depend on positions.
    """

    name = 'centre'

    def __init__(self, scenario):
        self._estimate = Estimate(np.array(scenario.roi_center_m), np.eye(3))

    def estimate(self, received):
        return self._estimate


def cycle():
    """Run the roles until a user is served; return pairs (sender, message) in order."""
    scenario = Scenario(n_subbands=2, n_frames=2, n_feeds=2, elements_per_side=4)
    codebook = random_codebook(scenario, np.random.default_rng(0))
    roles = {
        'user': user.User(
            {1: mobility.Static(scenario.roi_center_m)}, step_s=1.0, beacon_s=3.0),
        'channel': Channel(scenario, 0),
        'rhs_controller': RhsController(), 'transmission': Transmission(scenario),
        'positioner': Positioner(scenario, lambda: 0.0),
        'bs': BaseStation(
            scenario, BaseStationSettings(policy='first'), np.random.default_rng(0),
            lambda codebook, feeds, user, cycle_id, noise: receive_feeds(
                scenario, codebook, feeds, None)),
    }
    sent, queue, now_s = [], collections.deque(), 0.0

    def dispatch(name, event):
        for action in roles[name].handle(event, now_s):
            if isinstance(action, BuildEstimator):
                dispatch(name, build_estimator(
                    action.codebook, lambda codebook: _Centre(scenario), lambda: 0.0))
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


def svg():
    """Return an SVG document: a column for each role, a row for each run of equal messages."""
    rows = [(sender, kind, list(run)) for (sender, kind), run in itertools.groupby(
        cycle(), key=lambda item: (item[0], type(item[1])))]
    place = {name: _LEFT + _COLUMN * number for number, name in enumerate(RECEIVES)}
    width = _LEFT * 2 + _COLUMN * (len(RECEIVES) - 1)
    height = _TOP + _ROW * (len(rows) + 1)
    parts = []
    for name, x in place.items():
        parts.append(f'<text class="role" x="{x}" y="25" text-anchor="middle">{name}</text>')
        parts.append(f'<line class="life" x1="{x}" x2="{x}" y1="35" y2="{height - 10}"/>')
    for number, (sender, kind, run) in enumerate(rows):
        y = _TOP + _ROW * (number + 1)
        label = NAMES[kind] + _detail([message for _, message in run])
        recipients = [name for name, kinds in RECEIVES.items() if kind in kinds and name != sender]
        if kind is m.Data:
            recipients = (['channel'] if run[0][1].stage is m.Stage.OFFERED else
                      ['user' if run[0][1].direction is m.Direction.DOWNLINK else 'bs'])
        last = sender == list(RECEIVES)[-1]
        parts += _arrows(place[sender], [place[name] for name in recipients], y, label, last)
    return (f'<svg xmlns="http://www.w3.org/2000/svg" class="sequence" width="{width}" '
            f'height="{height}" viewBox="0 0 {width} {height}" role="img"><title>One cycle</title>'
            f'<style>{_STYLE}</style>{"".join(parts)}</svg>')


def _detail(messages):
    first = messages[0]
    if isinstance(first, m.Data):
        return f' {first.direction.name.lower()}, {first.stage.name.lower()}'
    if isinstance(first, m.ProtocolState):
        return f' {first.outcome or first.phase.name.lower()}'
    band = f' band {first.band}' if hasattr(first, 'band') else ''
    return band + (f', {len(messages)} times' if len(messages) > 1 else '')


def _arrows(begin, ends, y, label, last):
    """Return arrows from a sender to all recipients, with a label next to the sender."""
    parts = [f'<circle cx="{begin}" cy="{y}" r="3"/>']
    for end in ends:
        tip = 7 if end < begin else -7
        parts.append(f'<path d="M{begin} {y} L{end} {y} l{tip} -4 l0 8 L{end} {y}"/>')
    right = not last and (not ends or max(ends) > begin)
    anchor, x = ('start', begin + 8) if right else ('end', begin - 8)
    parts.append(f'<text class="label" x="{x}" y="{y - 5}" text-anchor="{anchor}">'
                 f'{html.escape(label)}</text>')
    return parts
