"""Example plug-ins for rhs_isac_ros."""
