"""``scripts/snapshot``: draws a picture of a running network."""

import argparse
import math
import sys
import time
from pathlib import Path

from rclpy.node import Node

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.network_state import SCENE_RECEIVES, SceneState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float, picture_file
from rhs_isac_ros.support.pictures import write_picture
from rhs_isac_ros.support.texts import listed
from rhs_isac_ros.system import add_files
from rhs_isac_ros.tools import command
from rhs_isac_ros.tools.command import ToolError
from rhs_isac_ros.tools.pictures import compose_scene

_PROGRAM = 'snapshot'
# By default, every user publishes its true position within this time [s]. While cycles run, the
# surface publishes its configuration within twice this time.
_REPORT_PERIOD_S = 0.5


class SnapshotNode(Node):
    """Collects the scene in its namespace, with times of `time.monotonic`.

    `mismatch` is the error of the last message that did not match the scenario, or ''.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__('snapshot', **WITHOUT_SERVICES)
        self.scene = SceneState()
        self.mismatch = ''
        # Time of the first message, and first time at which the scene was drawable.
        self._began_s = self._drawable_s = math.inf
        subscribe_messages(
            self, SCENE_RECEIVES, scenario, self._on_message, self._on_mismatch)

    def _on_message(self, message: m.Message, arrived_s: float) -> None:
        self._began_s = min(self._began_s, arrived_s)
        self.scene.add(message, arrived_s)
        if self.scene.drawable:
            self._drawable_s = min(self._drawable_s, arrived_s)

    def _on_mismatch(self, error: m.MessageError) -> None:
        self._began_s = min(self._began_s, time.monotonic())
        self.mismatch = str(error)

    def is_ready(self, wait_s: float) -> bool:
        """Return whether to draw the scene.

        Every user must have had time to report. The scene must be complete, or drawable for longer
        than `wait_s`.
        """
        now_s, scene = time.monotonic(), self.scene
        return now_s > self._began_s + _REPORT_PERIOD_S and (
            scene.complete or scene.drawable and now_s > self._drawable_s + wait_s)

    @property
    def has_other_scenario(self) -> bool:
        """Whether the network seems to use another scenario: no configuration matches."""
        return bool(self.mismatch and self.scene.configuration is None
                    and time.monotonic() > self._began_s + 2 * _REPORT_PERIOD_S)


def _snapshot(options: argparse.Namespace, arguments: list[str]) -> int:
    scenario = command.choose_scenario(options.config)
    end_s = time.monotonic() + options.timeout

    def done(node: SnapshotNode) -> bool:
        return (node.is_ready(options.wait) or node.has_other_scenario
                or time.monotonic() > end_s)
    node = command.observe(
        lambda: command.expecting_cycles(SnapshotNode(scenario)), arguments, done)
    if done(node):
        if node.mismatch and node.scene.configuration is None:
            raise ToolError(f'{node.mismatch}{command.OTHER_SCENARIO}')
        if not node.scene.users:
            raise command.none_within('no user found', options.timeout)
        draw(node.scene, scenario, options.output)
    return 0


def draw(scene: SceneState, scenario: Scenario, path: Path) -> None:
    """Draw a scene, and print the missing parts; raise OSError if the file cannot be written."""
    missing = _missing(scene)
    if missing:
        print(f'{_PROGRAM}: not in the picture: {"; ".join(missing)}', file=sys.stderr)
    write_picture(path, compose_scene(scene, scenario))
    print(path)


def _missing(scene: SceneState) -> list[str]:
    parts = []
    if scene.configuration is None:
        parts.append('the configuration of the surface')
    if scene.shown_beam is None:
        parts.append('a data beam')
    users = scene.without_estimate
    if users:
        parts.append(f'estimates of {len(users)} of {len(scene.users)} users: {listed(users)}')
    return parts


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Draw the scene of a network when every user has an '
        'estimate, or some seconds after the first estimate.')
    add = parser.add_argument
    add('--output', type=picture_file, default='scene.png', metavar='FILE',
        help='picture to write: PNG, PDF or SVG (default: scene.png)')
    add('--wait', type=nonnegative_float, default=5.0, metavar='S',
        help='time to wait for further estimates after the first one (default: 5 s)')
    add('--timeout', type=nonnegative_float, default=30.0, metavar='S',
        help='maximum wait in total; the known part of the scene is then drawn '
        '(default: 30 s)')
    add_files(parser, 'config')
    return parser


main = command.entry(_snapshot, _parser)
