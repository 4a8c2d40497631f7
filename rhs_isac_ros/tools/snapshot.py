"""``scripts/snapshot``: draws a picture of a running network."""

import argparse
import os
import sys
import time
from collections.abc import Sequence

from rclpy.node import Node

from rhs_isac_ros.executables import exit_code_of, print_error
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.network_state import SCENE_RECEIVES, SceneState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_registry import join_users
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.startup import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    nonnegative_float,
    picture_file,
)
from rhs_isac_ros.tools.command import run_command
from rhs_isac_ros.tools.pictures import draw_scene

_PROGRAM = 'snapshot'
# Within this time [s], every user publishes its true position; within twice this time, the
# surface publishes its configuration.
_REPORT_PERIOD_S = 0.5


class SnapshotNode(Node):
    """Collects the scene of its namespace.

    Attributes
    ----------
    scene
        The scene, with times of `time.monotonic`.
    mismatch
        Error of the last message that does not match the scenario; empty if there was none.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__('snapshot', **WITHOUT_SERVICES)
        self.scene = SceneState()
        self.mismatch = ''
        self._began_s: float | None = None
        self._drawable_s: float | None = None
        subscribe_messages(
            self, SCENE_RECEIVES, scenario.sizes, self._on_message, self._on_mismatch)

    def _on_message(self, message: m.Message) -> None:
        now_s = time.monotonic()
        self._began_s = self._began_s or now_s
        self.scene.add(message, now_s)
        if self._drawable_s is None and self.scene.drawable:
            self._drawable_s = now_s

    def _on_mismatch(self, error: m.MessageError) -> None:
        self.mismatch = str(error)

    def is_ready(self, wait_s: float) -> bool:
        """Return whether to draw the scene, after every user had time to report.

        It is complete, or it has been drawable for a time [s] although users lack an estimate.
        """
        if not self._receiving_for(_REPORT_PERIOD_S):
            return False
        return self.scene.complete or (
            self._drawable_s is not None and self.scene.drawable
            and time.monotonic() > self._drawable_s + wait_s)

    @property
    def has_other_scenario(self) -> bool:
        """Whether the network uses another scenario: no surface configuration matches."""
        return bool(self.mismatch and self.scene.configuration is None
                    and self._receiving_for(2 * _REPORT_PERIOD_S))

    def _receiving_for(self, duration_s: float) -> bool:
        return self._began_s is not None and time.monotonic() > self._began_s + duration_s


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the scene when it is complete, or after some time as far as it is known."""
    return run_command(_snapshot, _parser(), arguments, ['--config'], ['--output'])


def _snapshot(options: argparse.Namespace, arguments: list[str]) -> int:
    scenario = Scenario.from_yaml(options.config) if options.config else Scenario()
    nodes: list[SnapshotNode] = []
    end_s = time.monotonic() + options.timeout

    def create() -> list[SnapshotNode]:
        nodes.append(SnapshotNode(scenario))
        return nodes

    def done() -> bool:
        return (nodes[0].is_ready(options.wait) or nodes[0].has_other_scenario
                or time.monotonic() > end_s)
    code = run(create, arguments, done)
    if not nodes or not done():
        return code
    return write_picture(nodes[0].scene, nodes[0].mismatch, scenario, options)


def write_picture(
        scene: SceneState, mismatch: str, scenario: Scenario, options: argparse.Namespace) -> int:
    """Draw a scene and print what it lacks, or print why there is nothing to draw.

    Parameters
    ----------
    mismatch
        Error of a message that does not match the scenario, or empty.
    options
        ``output``, ``timeout``.

    Returns
    -------
    int
        Exit code: 0 or 1, as for `main`.
    """
    if mismatch and scene.configuration is None:
        print_error(f'{mismatch}; if the network uses another scenario, pass it with '
                    '--config FILE', _PROGRAM)
        return 1
    if not scene.users:
        print_error(f'no user found within {options.timeout:g} s, in the domain '
                    f'{os.environ.get("ROS_DOMAIN_ID", "0")} and this namespace', _PROGRAM)
        return 1
    missing = _missing(scene)
    if missing:
        print(f'{_PROGRAM}: not in the picture: {"; ".join(missing)}', file=sys.stderr)
    try:
        draw_scene(scene, scenario, options.output)
    except OSError as error:
        print_error(f'{options.output}: cannot be written: {error.strerror}', _PROGRAM)
        return 1
    print(options.output)
    return 0


def _missing(scene: SceneState) -> list[str]:
    """Describe each part that a scene lacks."""
    parts = []
    if scene.configuration is None:
        parts.append('the configuration of the surface')
    if scene.shown_beam is None:
        parts.append('a data beam')
    users = scene.without_estimate
    if users:
        parts.append(f'estimates of {len(users)} of {len(scene.users)} users: {join_users(users)}')
    return parts


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Draw the scene of a network when every user has an '
        'estimate, or some seconds after the first one. ROS arguments select the namespace: '
        '--ros-args -r __ns:=/lab')
    parser.add_argument('--output', type=picture_file, default='scene.png', metavar='FILE',
                        help='picture to write: PNG, PDF or SVG (default: scene.png)')
    parser.add_argument('--wait', type=nonnegative_float, default=5.0, metavar='S',
                        help='wait for the estimates of further users after the first one '
                        '(default: 5 s)')
    parser.add_argument('--timeout', type=nonnegative_float, default=30.0, metavar='S',
                        help='maximum wait in all; the scene is then drawn as far as it is known '
                        '(default: 30 s)')
    parser.add_argument('--config', type=input_file, metavar='FILE',
                        help="scenario file of the network; by default the paper's Table I")
    return parser


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
