"""Entry point of ``python3 -m system.chaos``."""

import sys

from rhs_isac_ros.support.exits import exit_code_of
from system.chaos.command import main

sys.exit(exit_code_of(main))
