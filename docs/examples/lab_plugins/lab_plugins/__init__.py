"""Plug-ins of a laboratory for rhs_isac_ros."""
