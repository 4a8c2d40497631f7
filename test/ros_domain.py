"""The ROS domains of this test process, which no other test process of the machine uses."""

import atexit
import os
import socket


def claim_domain() -> str:
    """Return a domain that no other process has claimed; the claim ends with this process."""
    # Above 101, the ports of a domain may collide with the ephemeral ports of Linux.
    for offset in range(101):
        domain = 1 + (os.getpid() + offset) % 101
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # An abstract name of Linux; it disappears with the socket.
            claim.bind(f'\0rhs_isac_ros.test.domain.{domain}')
        except OSError:
            claim.close()
        else:
            atexit.register(claim.close)
            return str(domain)
    raise RuntimeError('all 101 domains are claimed by other test processes')
