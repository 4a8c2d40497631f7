"""Where the protocol meets ROS 2: topics, quality of service, conversions, parameters, nodes."""
