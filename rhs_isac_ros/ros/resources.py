"""Files that come with the package."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory


def default_codebook_file() -> Path:
    """Return where the default codebook lies.

    Returns
    -------
    pathlib.Path
        The file ``config/codebook.yaml`` of the installed package.
    """
    return Path(get_package_share_directory('rhs_isac_ros')) / 'config' / 'codebook.yaml'


def discovery_profile_file() -> Path:
    """Return where the profile for a swift discovery lies.

    Returns
    -------
    pathlib.Path
        The file ``config/discovery.xml`` of the installed package, for Fast DDS.
    """
    return Path(get_package_share_directory('rhs_isac_ros')) / 'config' / 'discovery.xml'
