"""ROS 2 adapters for the protocol: topics, quality of service, conversions, parameters, nodes."""
