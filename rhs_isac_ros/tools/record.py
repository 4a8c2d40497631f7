"""``scripts/record FILE``: records topics and the scenario of a network."""

import argparse

from rclpy.node import Node

from rhs_isac_ros.positioning import Site
from rhs_isac_ros.ros.endpoints import log
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.recording import Recorder
from rhs_isac_ros.support.arguments import ArgumentParser, input_file, output_file
from rhs_isac_ros.tools.command import ToolError, choose_scenario, entry, observe


class RecorderNode(Node):
    """Records the network in its namespace; the caller closes the file."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__('recorder', **WITHOUT_SERVICES)
        self._topics: set[str] = set()
        recorder.record_topics(self, self._log_topic)
        log(self, 'recording; press Ctrl-C to stop')

    def _log_topic(self, name: str) -> None:
        if name not in self._topics:
            self._topics.add(name)
            log(self, f'first message of {name}')


def _record(options: argparse.Namespace, arguments: list[str]) -> int:
    site = Site.from_yaml(options.site) if options.site else None
    recorder = Recorder(options.file, site.surfaces[site.leader].scenario if site
                        else choose_scenario(options.config), site)
    try:
        observe(lambda: RecorderNode(recorder), arguments, lambda _: bool(recorder.failure))
    finally:
        recorder.close()
    if recorder.failure:
        raise ToolError(recorder.failure)
    print(f'{recorder.count} messages in {options.file}')
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='record', description='Record a network as MCAP until Ctrl-C, or a site with the '
        'networks of all surfaces.')
    parser.add_argument('file', type=output_file, help='recording to write')
    files = parser.add_mutually_exclusive_group()
    for name, text in [
            ('config', "scenario file of the network; the paper's Table I if empty"),
            ('system', 'system file, instead of a scenario file'),
            ('site', 'site file, instead of a scenario file')]:
        # Launch files pass an empty name by default.
        files.add_argument(f'--{name}', metavar='FILE', help=text,
                           type=lambda text: input_file(text) if text else None)
    return parser


main = entry(_record, _parser)
