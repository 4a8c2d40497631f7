"""Runs a command: ``python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]``.

A command of another package is the name of its module, with a dot.
"""

import sys

from rhs_isac_ros.executables import run

if len(sys.argv) < 2:
    sys.exit('usage: python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]')
name = sys.argv.pop(1)
sys.exit(run(name if '.' in name else f'rhs_isac_ros.tools.{name}', name.rpartition('.')[2]))
