"""Runs a command: ``python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]``."""

import importlib
import sys

from rhs_isac_ros.support.exits import exit_code_of

if len(sys.argv) < 2:
    sys.exit('usage: python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]')
name = sys.argv.pop(1)
sys.exit(exit_code_of(importlib.import_module(f'rhs_isac_ros.tools.{name}').main, program=name))
