"""Monitoring of a running network from its messages, without ROS and without taking part."""
