"""Runs a command: ``python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]``."""

import sys

from rhs_isac_ros.support.exits import exit_code_of, import_main

if len(sys.argv) < 2:
    sys.exit('usage: python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]')
name = sys.argv.pop(1)
sys.exit(exit_code_of(import_main(f'rhs_isac_ros.tools.{name}'), program=name))
