"""The codebooks that come with the package, both in a clone and in an installation."""

from pathlib import Path

from rhs_isac_ros.codebook.codebook import CodebookError


def default_codebook_file() -> Path:
    """Return the path of the default codebook, ``config/codebook.yaml``.

    Raises
    ------
    CodebookError
        If the package was installed without its data files.
    """
    # Every installation scheme puts share/ into a folder above the modules: the prefix of pip and
    # colcon, or the folder of pip's --target. A clone has config/ beside the package.
    package = Path(__file__).resolve().parents[1]
    folders = [package.parent / 'config',
               *(folder / 'share' / 'rhs_isac_ros' / 'config' for folder in package.parents)]
    for folder in folders:
        if (file := folder / 'codebook.yaml').is_file():
            return file
    raise CodebookError(f'codebook.yaml: not found in {folders[0]}, nor in '
                        f'share/rhs_isac_ros/config of any folder above {package}')
