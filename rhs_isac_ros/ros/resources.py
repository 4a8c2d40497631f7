"""Files of the installed package."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory


def discovery_profile_file() -> Path:
    """Return the path of the Fast DDS discovery profile, ``config/discovery.xml``."""
    return Path(get_package_share_directory('rhs_isac_ros')) / 'config' / 'discovery.xml'
