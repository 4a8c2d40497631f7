"""What a laboratory adds to rhs_isac_ros, without changing it."""
