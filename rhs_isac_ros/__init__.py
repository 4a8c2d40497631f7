"""Position-then-transmit with a multi-band reconfigurable holographic surface, on ROS 2."""

__version__ = '1.0.0'
