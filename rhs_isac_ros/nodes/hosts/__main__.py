"""The command of ``scripts/hosts``."""

import sys

from rhs_isac_ros.nodes.hosts.command import main

if __name__ == '__main__':
    sys.exit(main())
