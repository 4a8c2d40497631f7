"""Entry point of ``python -m system.hosts``."""

import sys

from system.hosts.command import main

if __name__ == '__main__':
    sys.exit(main())
