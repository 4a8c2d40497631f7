"""Entry point of ``python -m system.chaos``."""

import sys

from system.chaos.command import main

sys.exit(main())
