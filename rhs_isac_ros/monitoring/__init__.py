"""Passive monitoring of a running network from its messages, without ROS."""
