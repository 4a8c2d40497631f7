"""ROS 2 adapters of the protocol: topics, quality of service, conversions, parameters, nodes."""
