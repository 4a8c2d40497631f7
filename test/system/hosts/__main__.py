"""Entry point of ``python3 -m system.hosts``."""

import sys

from rhs_isac_ros.executables import exit_code_of
from system.hosts.command import main

if __name__ == '__main__':
    sys.exit(exit_code_of(main))
