"""The example of two robots in a simulation."""

import importlib.util
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rhs_isac_ros.protocol import messages as m

EXAMPLES = Path(__file__).parents[2] / 'docs' / 'examples'
_SPEC = importlib.util.spec_from_file_location('two_robots', EXAMPLES / 'two_robots.py')
EXAMPLE = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(EXAMPLE)
needs_tf2 = pytest.mark.skipif(
    importlib.util.find_spec('tf2_ros') is None,
    reason='tf2_ros is not installed: it is part of a full ROS 2, not a wheel')


def line_of(estimate):
    """Return the line that the script prints for an estimate."""
    now_s = 1e-9 * estimate.stamp_ns
    x, y, _ = EXAMPLE.drive(estimate.user, now_s)
    error_m = math.dist((x, y, EXAMPLE.HEIGHT_M), estimate.position)
    return (f'robot {estimate.user} at {now_s - EXAMPLE.BEGIN_S:8.2f} s: '
            f'{estimate.position[0]:6.2f} {estimate.position[1]:6.2f} m in map, '
            f'error {error_m:.2f} m')


# A robot of its own for each user, by odometry or by a frame of tf2.
@pytest.mark.parametrize('mobility', ['odometry', pytest.param('tf', marks=needs_tf2)])
def test_two_robots_are_located_in_the_map(mobility, processes, make_watch, tmp_path):
    """The script prints what the network estimates, and its distance from the true position."""
    files = ['--params-file', str(EXAMPLES / 'two_robots.yaml')]
    if mobility == 'tf':
        (tmp_path / 'tf.yaml').write_text(''.join(
            f'/**/user_{user}:\n  ros__parameters:\n    mobility: tf\n'
            f'    robot_frame: robot_{user}/base_link\n' for user in (1, 2)), encoding='utf-8')
        files += ['--params-file', str(tmp_path / 'tf.yaml')]
    space = f'/robots_{mobility}'
    watch = make_watch(space)
    network = processes.start(
        'network', *files, namespace=space, rest_s=0.1, scenario_file=EXAMPLES / 'wall.yaml',
        codebook_file=EXAMPLES.parents[1] / 'config' / 'codebook_bandplan.yaml')
    output = tmp_path / 'output.txt'
    with output.open('w', encoding='utf-8') as stream, subprocess.Popen(
            [sys.executable, EXAMPLES / 'two_robots.py', '--rate', '2', '--poses', '10',
             '--picture', tmp_path / 'robots.png', '--ros-args', '-r', f'__ns:={space}'],
            stdout=stream, stderr=stream) as process:
        try:
            watch.until(lambda: process.poll() is not None, 'the poses', [network])
        finally:
            process.kill()
    text = output.read_text(encoding='utf-8')
    assert process.returncode == 0, text
    expected = set(map(line_of, watch.received[m.PositionEstimate]))
    for robot in (1, 2):
        lines = re.findall(rf'^robot {robot} at .*', text, re.MULTILINE)
        assert len(lines) >= 10
        assert expected.issuperset(lines)
    assert (tmp_path / 'robots.png').stat().st_size > 5000
