"""What ``scripts/param`` and ``scripts/topic`` share, the stand-ins for commands of ``ros2``."""

import argparse
import sys

from rhs_isac_ros.ros.run import starting
from rhs_isac_ros.ros.session import Session
from rhs_isac_ros.tools.command import ToolError


def run_verb(options: argparse.Namespace, arguments: list[str]) -> int:
    """Call ``options.verb`` with a session and the options, and return the exit code.

    As in ``ros2``, errors do not start with the name of the program.
    """
    try:
        with Session(arguments) as session, starting():
            options.verb(session, options)
    except ToolError as error:
        print(error, file=sys.stderr)
        return 1
    return 0
