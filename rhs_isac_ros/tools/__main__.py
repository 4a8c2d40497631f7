"""Runs a command: ``python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]``.

A command of another package is the name of its module, with a dot.
"""

import sys

from rhs_isac_ros.support.exits import exit_code_of, import_main

if len(sys.argv) < 2:
    sys.exit('usage: python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]')
name = sys.argv.pop(1)
sys.exit(exit_code_of(import_main(name if '.' in name else f'rhs_isac_ros.tools.{name}'),
                      program=name.rpartition('.')[2]))
