"""Tools for the terminal where there is no command ``ros2``; they need rclpy alone."""
