"""The position-then-transmit protocol, independent of ROS and without input or output."""
