"""``python -m rhs_isac_ros.nodes.chaos``."""

import sys

from rhs_isac_ros.nodes.chaos.command import main

sys.exit(main())
