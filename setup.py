"""The ament_python package rhs_isac_ros; without ROS, pip installs the library alone."""

import os
import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'rhs_isac_ros'
NODES = sorted(path.stem for path in Path(__file__).parent.glob(f'{NAME}/nodes/[a-z]*.py'))
# The demonstration, and the terminal tools that have no counterpart in `ros2`.
TOOLS = ('calibrate', 'demo', 'record', 'replay', 'snapshot', 'view', 'watch')

# colcon does not search for packages inside a package, and installs this one without its messages.
if 'COLCON' in os.environ and not any(
        (Path(prefix) / 'share' / 'rhs_isac_msgs').is_dir()
        for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)):
    print(f'{NAME}: the package rhs_isac_msgs is missing: in the src folder of the workspace, run '
          '`ln -s rhs_isac_ros/msg_defs rhs_isac_msgs`, then repeat colcon build', file=sys.stderr)

setup(
    name=NAME,
    version='1.0.0',
    description='Multi-band integrated sensing and communication with a holographic surface',
    author='rhs_isac_ros authors',
    author_email='maintainers@rhs-isac-ros.org',
    maintainer='rhs_isac_ros authors',
    maintainer_email='maintainers@rhs-isac-ros.org',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*.*'))),
        (f'share/{NAME}/config/rviz', sorted(glob('config/rviz/*.*'))),
        (f'share/{NAME}/config/sros2', sorted(glob('config/sros2/*.*'))),
        (f'share/{NAME}/config/scenarios', sorted(glob('config/scenarios/*.*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.*'))),
    ],
    python_requires='>=3.10',
    # The library requires nothing else. The nodes also require ROS 2, which pip cannot install:
    # rosdep reads package.xml, and scripts/setup reads requirements*.txt.
    install_requires=['numpy>=1.26', 'scipy>=1.11', 'pyyaml>=6', 'threadpoolctl>=3.1'],
    # Tests and the documentation read this table as a literal.
    extras_require={
        'plot': ['matplotlib'],
        'experiments': ['joblib', 'dask', 'distributed', 'tqdm'],
        'neural': ['scikit-learn'],
        'genetic': ['pymoo'],
        'recording': ['mcap>=1.6'],
        'samples': ['sigmf'],
        'touchstone': ['scikit-rf'],
        'matlab': ['h5py'],
        'watch': ['rich'],
        'view': ['rerun-sdk>=0.22.1,<0.42', 'pyarrow'],
        'all': [
            'matplotlib', 'joblib', 'dask', 'distributed', 'tqdm', 'scikit-learn',
            'pymoo', 'mcap>=1.6', 'sigmf', 'scikit-rf', 'h5py', 'rich', 'rerun-sdk>=0.22.1,<0.42',
            'pyarrow'],
        'docs': ['sphinx', 'furo', 'myst-nb'],
        'test': ['pytest', 'hypothesis', 'filterpy', 'rosbags', 'mcap-ros2-support'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            f'{name} = {NAME}.executables:{name}' for name in (*NODES, *TOOLS)
        ],
    },
)
