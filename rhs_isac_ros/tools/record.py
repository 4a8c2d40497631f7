"""``scripts/record FILE``: takes down everything that is said in a network."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.ros.recording import Recorder, RecordingError
from rhs_isac_ros.ros.run import run


class RecorderNode(Node):
    """Records the topics of its namespace until it is destroyed.

    Parameters
    ----------
    recorder
        Writes the file.
    """

    def __init__(self, recorder: Recorder) -> None:
        super().__init__('recorder')
        self._recorder = recorder
        self._seen: set[str] = set()
        recorder.listen(self, self._report)
        self.get_logger().info('recording; Ctrl-C ends it')

    def _report(self, name: str, _: bytes) -> None:
        if name not in self._seen:
            self._seen.add(name)
            self.get_logger().info(f'first message of {name}')

    def destroy_node(self) -> None:
        """End the node, then complete the file."""
        super().destroy_node()
        self._recorder.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Record until a signal comes.

    Parameters
    ----------
    arguments
        Command line, ROS arguments among it; by default the process's.

    Returns
    -------
    int
        Exit code: 0 after a signal; 2 if an argument or a file is wrong.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(remove_ros_args(['record', *arguments])[1:])
    try:
        scenario = Scenario.from_yaml(options.config) if options.config else Scenario()
        recorder = Recorder(options.file, scenario)
    except (ScenarioError, RecordingError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    try:
        code = run(lambda: [RecorderNode(recorder)], ['record', *arguments])
    finally:
        recorder.close()
    print(f'{recorder.count} messages in {options.file}')
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='record', description='Record a network as MCAP until Ctrl-C. ROS arguments choose '
        'the namespace: --ros-args -r __ns:=/lab')
    parser.add_argument('file', type=Path, help='recording to write')
    # Launch files pass an empty name where none is given.
    parser.add_argument('--config', metavar='FILE',
                        help="scenario file of the network; the paper's Table I if none or empty")
    return parser


if __name__ == '__main__':
    sys.exit(main())
