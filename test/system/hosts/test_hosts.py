"""``scripts/hosts`` with real network namespaces, where they are available, and its verdicts."""

import contextlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rhs_isac_ros.monitoring.cycle_log import CycleTimes
from system.hosts.__main__ import evaluate

# The parent directory of the package `system`.
FOLDER = Path(__file__).parents[2]


def namespaces_of(pid):
    return [path.name for path in Path('/run/netns').glob(f'rhs_isac-{pid}-*')]


@pytest.fixture
def start(small_files):
    """Function that starts the command, and returns once it has hosts; skips without them."""
    with contextlib.ExitStack() as stack:
        def start(*options):
            process = stack.enter_context(subprocess.Popen(
                [sys.executable, '-m', 'system.hosts', *options, '--config',
                 small_files / 'scenario.yaml', '--codebook', small_files / 'first.yaml'],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=FOLDER))
            stack.callback(process.kill)
            first = process.stderr.readline()
            if 'no network namespaces' in first:
                pytest.skip(first)
            assert first == 'hosts created\n'
            assert len(namespaces_of(process.pid)) == 7
            return process
        yield start


def test_the_namespaces_of_killed_and_interrupted_runs_are_removed(start):
    killed = start()
    killed.kill()
    killed.communicate(timeout=240)
    assert namespaces_of(killed.pid)
    interrupted = start()
    assert not namespaces_of(killed.pid)
    interrupted.send_signal(signal.SIGTERM)
    interrupted.communicate(timeout=240)
    assert interrupted.returncode == 130
    assert not namespaces_of(interrupted.pid)


def test_cycles_are_served_after_an_outage(start):
    process = start('--pull', 'channel', '--seconds', '1')
    out, err = process.communicate(timeout=400)
    assert out, err
    figures = json.loads(out)
    (outage,) = figures['outages']
    assert process.returncode == (0 if figures['passed'] else 1), out + err
    assert (outage['host'], outage['during'], figures['wrong_publications']) == ('channel', 0, 0)
    # The time to recover depends on the load of the machine; recovery itself does not.
    assert outage['recovery_s'] is not None
    assert not namespaces_of(process.pid)


# The verdict on an outage from 5 to 11 s

SPANS_S = ((1.0, 1.1), (2.0, 2.1), (4.95, 5.05), (11.5, 11.6))
LOG = '[WARN] [bs]: waiting for channel\n'
REPORTED = ('1 cycles given up', 'waiting for channel')
PASSED = {'recovery_s': pytest.approx(0.6), 'during': 0, 'unreported': [], 'repeated': []}


@pytest.mark.parametrize(('changed', 'figures'), [
    ({}, {}),
    ({'spans_s': ((10.9, 11.2), (13.9, 14.01))}, {'recovery_s': pytest.approx(3.01)}),  # late
    ({'spans_s': ((10.9, 11.2),)}, {'recovery_s': None}),  # no cycle began after the outage
    ({'spans_s': ((7.0, 7.1), (11.5, 11.6))}, {'during': 1}),  # bypassed the link
    ({'log': ''}, {'unreported': ['bs']}), ({'warnings': REPORTED[:1]}, {'unreported': ['bs']}),
    ({'log': 2 * LOG}, {'repeated': ['bs']}), ({'log': LOG + 'waiting for positioner\n'}, {}),
    # Users miss an unreachable node later than the base station, which misses no user.
    ({'log': '', 'host': 'users'}, {}), ({'log': '', 'down_s': 7.0}, {}),
    ({'down_s': -11.9, 'spans_s': SPANS_S[3:]}, {}),
    ({'down_s': -12.0, 'spans_s': SPANS_S[3:]}, {'unreported': ['user_1']})])
def test_an_outage_passes_that_ends_in_time_and_is_reported_once(changed, figures):
    given = {'spans_s': SPANS_S, 'log': LOG, 'warnings': REPORTED, 'host': 'channel',
             'down_s': 5.0} | changed
    cycles = [CycleTimes(number, began_s=start, ended_s=end)
              for number, (start, end) in enumerate(given['spans_s'])]
    result = evaluate(given['host'], given['down_s'], 11.0, cycles, {
        'bs': given['log'], 'user_1': 'listening for beacons\n'}, {'bs': given['warnings']})
    assert result == {'host': given['host'], 'outage_s': 11.0 - given['down_s'],
                      'passed': not figures} | PASSED | figures
