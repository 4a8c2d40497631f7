"""Observation of a running network from its messages: no ROS, no part in the protocol."""
