"""``scripts/snapshot`` on a network in another process."""

import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.network_state import SceneState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.tools.snapshot import SnapshotNode, draw

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / 'scripts' / 'snapshot'


@pytest.fixture
def snapshot(built_scripts, tmp_path):
    """Function that runs the script in an empty directory."""
    def call(*arguments):
        return subprocess.run([SCRIPT, *arguments], cwd=tmp_path, capture_output=True, text=True,
                              timeout=90, check=False)
    return call


def test_snapshot_draws_a_running_network(shared_session, snapshot, tmp_path):
    done = snapshot('--config', ROOT / 'config' / 'quick.yaml', '--output', 'now.png')
    assert (done.returncode, done.stdout, done.stderr) == (0, 'now.png\n', '')
    assert [path.name for path in tmp_path.iterdir()] == ['now.png']
    content = (tmp_path / 'now.png').read_bytes()
    width, height = struct.unpack('>II', content[16:24])
    assert content.startswith(b'\x89PNG') and width > 1000 and height > 800


def test_a_network_of_another_scenario_is_named(shared_session, snapshot, tmp_path):
    done = snapshot()
    assert (done.returncode, done.stdout) == (1, '')
    assert 'another scenario, pass it with --config FILE' in done.stderr
    assert not list(tmp_path.iterdir())


def test_of_many_users_without_an_estimate_few_are_named(tmp_path, capsys):
    scene = SceneState()
    scene.add(m.GroundTruths(
        cycle_id=0, users=np.arange(1, 21), position=np.full((20, 3), (9.0, 1.0, 0.3)),
        velocity=np.zeros((20, 3))), 0.0)
    draw(scene, Scenario(), tmp_path / 'now.png')
    assert capsys.readouterr().err == (
        'snapshot: not in the picture: the configuration of the surface; a data beam; '
        'estimates of 20 of 20 users: 1, 2, 3, 4, 5, 6, 7, 8 and 12 others\n')


def test_it_does_not_wait_for_all_users_of_a_large_network(spin_until):
    """An absent user, whose true position is known, never has an estimate."""
    node = SnapshotNode(Scenario.from_yaml(ROOT / 'config' / 'quick.yaml'))
    node.scene.add(m.GroundTruth(
        cycle_id=0, user=99, position=np.array([9.0, 1.0, 0.3]), velocity=np.zeros(3)), 0.0)
    spin_until(node, lambda: node.is_ready(0.2))
    assert 99 in node.scene.without_estimate
    assert not node.is_ready(1e6)
