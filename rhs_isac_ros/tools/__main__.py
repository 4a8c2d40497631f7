"""Runs a command: ``python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]``.

A command of another package is the name of its module, with a dot.
"""

import sys
from pathlib import Path

from rhs_isac_ros.executables import run
from rhs_isac_ros.support.exits import print_error

if len(sys.argv) < 2:
    sys.exit('usage: python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]')
name = sys.argv.pop(1)
if '.' not in name and not (Path(__file__).with_name(f'{name}.py')).is_file():
    print_error(f'no command named {name}')
    sys.exit(2)
sys.exit(run(name if '.' in name else f'rhs_isac_ros.tools.{name}', name.rpartition('.')[2]))
