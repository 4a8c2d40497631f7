"""``scripts/snapshot``: a picture of a network at work."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.monitoring.scene_state import RECEIVES, SceneState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.subscriptions import listen
from rhs_isac_ros.tools.scene_picture import draw

# Every user tells its true position in this time, and in twice this the surface what it applies;
# with some room.
_ROUND_S = 0.5


class SnapshotNode(Node):
    """Looks at the scene of its namespace.

    Parameters
    ----------
    scenario
        The scenario.

    Attributes
    ----------
    sightings
        The scene.
    began_s
        When the first message was heard, on `time.monotonic` [s]; None before.
    misfit
        Why the last message that did not fit the scenario did not; empty if all fit.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__('snapshot', start_parameter_services=False)
        self.sightings = SceneState()
        self.began_s: float | None = None
        self.misfit = ''
        listen(self, RECEIVES, scenario.sizes, self._take, self._drop)

    def _take(self, message: m.Message) -> None:
        now_s = time.monotonic()
        self.began_s = self.began_s or now_s
        self.sightings.add(message, now_s)

    def _drop(self, error: m.MessageError) -> None:
        self.misfit = str(error)

    @property
    def complete(self) -> bool:
        """Whether there was time to hear of every user, and the scene is complete."""
        return self.sightings.complete and self._heard_for(_ROUND_S)

    @property
    def foreign(self) -> bool:
        """Whether the network is of another scenario: nothing of the surface fits."""
        return bool(self.misfit and self.sightings.configuration is None
                    and self._heard_for(2 * _ROUND_S))

    def _heard_for(self, duration_s: float) -> bool:
        return self.began_s is not None and time.monotonic() > self.began_s + duration_s


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the scene once it is complete, or what there is of it after a while.

    Parameters
    ----------
    arguments
        Command line, ROS arguments among it; by default the process's.

    Returns
    -------
    int
        Exit code: 0, also after a signal; 1 if there is no network or the picture cannot be
        written; 2 if an argument or a file is wrong.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = _parser()
    options = parser.parse_args(remove_ros_args(['snapshot', *arguments])[1:])
    if not options.output.resolve().parent.is_dir():
        parser.error(f'argument --output: {options.output}, expected a file in a directory that '
                     'exists')
    try:
        scenario = Scenario.from_yaml(options.config) if options.config else Scenario()
    except ScenarioError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    nodes, end_s = [], time.monotonic() + options.timeout

    def make() -> list[SnapshotNode]:
        nodes.append(SnapshotNode(scenario))
        return nodes
    def done() -> bool:
        node = nodes[0]
        return node.complete or node.foreign or time.monotonic() > end_s
    code = run(make, ['snapshot', *arguments], done)
    if not nodes or not done():
        return code
    return finish(nodes[0], scenario, options)


def finish(node: SnapshotNode, scenario: Scenario, options: argparse.Namespace) -> int:
    """Draw what a node has seen, or say why there is nothing to draw.

    Parameters
    ----------
    node
        The node.
    scenario
        The scenario.
    options
        ``output``, ``timeout``.

    Returns
    -------
    int
        Exit code: 0, or 1 as of `main`.
    """
    sightings = node.sightings
    if node.misfit and sightings.configuration is None:
        print(f'error: {node.misfit}: is it a network of another scenario? --config FILE',
              file=sys.stderr)
        return 1
    if not sightings.users:
        print(f'error: no user was heard of within {options.timeout:g} s, in the domain '
              f'{os.environ.get("ROS_DOMAIN_ID", "0")} and this namespace', file=sys.stderr)
        return 1
    missing = sorted(user for user, one in sightings.users.items() if not one.estimate)
    if missing:
        print(f'no estimate within {options.timeout:g} s of user '
              f'{", ".join(map(str, missing))}', file=sys.stderr)
    try:
        draw(sightings, scenario, options.output)
    except OSError as error:
        print(f'error: {options.output}: cannot be written: {error.strerror}', file=sys.stderr)
        return 1
    print(options.output)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='snapshot', description='Draw the scene of a network once every user has an '
        'estimate. ROS arguments choose the namespace: --ros-args -r __ns:=/lab')
    parser.add_argument('--output', type=Path, default=Path('scene.png'), metavar='FILE',
                        help='PNG file to write (default: scene.png)')
    parser.add_argument('--timeout', type=float, default=30.0, metavar='S',
                        help='draw what there is after this time (default: 30 s)')
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help="scenario file of the network; the paper's Table I if none")
    return parser


if __name__ == '__main__':
    sys.exit(main())
