"""The example of two robots in a simulation."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / 'docs' / 'examples'
needs_tf2 = pytest.mark.skipif(
    importlib.util.find_spec('tf2_ros') is None,
    reason='tf2_ros is not installed: it is part of a full ROS 2, not a wheel')


# A robot of its own for each user, by odometry or by a frame of tf2.
@pytest.mark.parametrize('mobility', ['odometry', pytest.param('tf', marks=needs_tf2)])
def test_two_robots_are_located_in_the_map(mobility, processes, tmp_path):
    files = ['--params-file', str(EXAMPLES / 'two_robots.yaml')]
    if mobility == 'tf':
        (tmp_path / 'tf.yaml').write_text(''.join(
            f'/**/user_{user}:\n  ros__parameters:\n    mobility: tf\n'
            f'    robot_frame: robot_{user}/base_link\n' for user in (1, 2)), encoding='utf-8')
        files += ['--params-file', str(tmp_path / 'tf.yaml')]
    space = f'/robots_{mobility}'
    processes.start('network', *files, namespace=space, rest_s=0.0,
                    scenario_file=EXAMPLES / 'wall.yaml',
                    codebook_file=EXAMPLES.parents[1] / 'config' / 'codebook_bandplan.yaml')
    done = subprocess.run(
        [sys.executable, EXAMPLES / 'two_robots.py', '--rate', '2', '--poses', '10',
         '--picture', tmp_path / 'robots.png', '--ros-args', '-r', f'__ns:={space}'],
        capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    for robot in (1, 2):
        errors = [float(error) for error in re.findall(
            rf'^robot {robot} at .* in map, error (.*) m$', done.stdout, re.MULTILINE)]
        assert len(errors) >= 10
        # As with the mobilities of the package; a random point of the region is 5 m away.
        assert np.median(errors) < 2.5
    assert (tmp_path / 'robots.png').stat().st_size > 5000
