"""The ament_python package rhs_isac_ros."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'rhs_isac_ros'
NODES = (
    'bs',
    'channel',
    'demo',
    'network',
    'optimizer',
    'positioner',
    'rhs_controller',
    'transmission',
    'user',
    'visualizer',
)
# Of the tools for the terminal, those that `ros2` lacks.
TOOLS = ('record', 'replay', 'snapshot', 'watch')

setup(
    name=NAME,
    version='0.1.0',
    description='Multi-band integrated sensing and communication with a holographic surface',
    author='rhs_isac_ros authors',
    author_email='maintainers@rhs-isac-ros.org',
    maintainer='rhs_isac_ros authors',
    maintainer_email='maintainers@rhs-isac-ros.org',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*.*'))),
        (f'share/{NAME}/config/rviz', sorted(glob('config/rviz/*.*'))),
        (f'share/{NAME}/config/sros2', sorted(glob('config/sros2/*.*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.*'))),
    ],
    python_requires='>=3.10',
    # What it runs on is in package.xml: rosdep or requirements.txt install it.
    install_requires=['setuptools'],
    extras_require={
        'docs': ['sphinx'],
        'experiments': ['dask', 'distributed', 'joblib'],
        'neural': ['scikit-learn'],
        'genetic': ['pymoo'],
        'recording': ['mcap'],
        'watch': ['rich'],
        'test': ['mcap-ros2-support', 'pytest', 'rosbags'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            f'{name} = {NAME}.executables:{name}' for name in (*NODES, *TOOLS)
        ],
    },
)
