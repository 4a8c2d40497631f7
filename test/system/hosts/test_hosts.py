"""``scripts/hosts`` with real network namespaces, where they are available, and its verdicts."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rhs_isac_ros.monitoring.cycle_log import CycleTimes
from system.hosts import namespaces
from system.hosts.__main__ import SKIPPED, main
from system.hosts.trial import evaluate

# The parent directory of the package `system`.
FOLDER = Path(__file__).parents[2]
# Creates hosts, prints a line, and waits for a signal.
HOLD = '''
import signal
from system.hosts.__main__ import interrupt_on_signals
from system.hosts.namespaces import connected_hosts

interrupt_on_signals()
try:
    with connected_hosts():
        print('created', flush=True)
        signal.pause()
except KeyboardInterrupt:
    print('removed')
'''


def namespaces_of(pid):
    return [path.name for path in Path('/run/netns').glob(f'rhs_isac-{pid}-*')]


def popen(*arguments):
    return subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, cwd=FOLDER)


@pytest.fixture
def hold():
    """A process with hosts; skips the test where they are unavailable."""
    with popen('-c', HOLD) as process:
        if process.stdout.readline() != 'created\n':
            _, err = process.communicate(timeout=60)
            if 'NamespacesUnavailable' in err:
                pytest.skip(f'no network namespaces here: {err.splitlines()[-1]}')
            raise AssertionError(err)
        yield process
        process.kill()


@pytest.fixture
def files(small_files):
    return ['--config', str(small_files / 'scenario.yaml'),
            '--codebook', str(small_files / 'first.yaml')]


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_removes_all_namespaces(hold, number):
    assert len(namespaces_of(hold.pid)) == 7
    hold.send_signal(number)
    assert hold.communicate(timeout=60) == ('removed\n', '')
    assert not namespaces_of(hold.pid)


def test_an_outage_passes_and_namespaces_of_a_killed_run_are_removed(hold, files, tmp_path):
    hold.kill()
    hold.wait()
    assert namespaces_of(hold.pid)
    with popen('-m', 'system.hosts', '--pull', 'channel', '--seconds', '1',
               '--json', str(tmp_path / 'figures.json'), *files) as done:
        out, err = done.communicate(timeout=120)
    figures = json.loads((tmp_path / 'figures.json').read_text(encoding='utf-8'))
    (outage,) = figures['outages']
    assert done.returncode == 0, out + err
    assert figures['passed']
    assert outage['host'] == 'channel'
    assert outage['recovery_s'] <= 3.0
    assert outage['before'] > 0
    assert figures['wrong_publications'] == 0
    # Every host has used its link.
    assert min(figures['packets'].values()) > 100
    assert not namespaces_of(hold.pid)
    assert not namespaces_of(done.pid)


def test_the_trial_is_skipped_without_the_command_ip(files, monkeypatch, capsys):
    for name, value in os.environ.items():
        # monkeypatch restores what the command sets.
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('PATH', '/nonexistent')
    assert main(files) == SKIPPED
    assert 'skipped' in capsys.readouterr().err


def test_every_node_has_one_host():
    nodes = sum(namespaces.HOSTS.values(), ())
    assert len(nodes) == len(set(nodes))
    prefix = namespaces.command_prefix('user_12')
    assert prefix == ['ip', 'netns', 'exec', f'rhs_isac-{os.getpid()}-users']


# The verdict on an outage from 5 to 11 s

SPANS_S = ((1.0, 1.1), (2.0, 2.1), (4.95, 5.05), (11.5, 11.6))
LOG = '[WARN] [bs]: waiting for channel\n'
REPORTED = ('1 cycles given up', 'waiting for channel')


def outage(spans_s=SPANS_S, log=LOG, warnings=REPORTED, host='channel', restored_s=11.0):
    cycles = [CycleTimes(number, began_s=start, ended_s=end)
              for number, (start, end) in enumerate(spans_s)]
    return evaluate(host, (0.0, 5.0, restored_s, restored_s + 3), cycles,
                    {'bs': log, 'user_1': 'listening for beacons\n'}, {'bs': warnings})


def test_an_outage_that_is_reported_passes():
    result = outage()
    assert result.passed
    assert (result.before, result.during, result.after, result.outage_s) == (2, 0, 1, 6.0)
    assert result.figures()['recovery_s'] == pytest.approx(0.6)
    assert result.logged == ('bs',)


@pytest.mark.parametrize(('changed', 'figures'), [
    ({'spans_s': ((10.9, 11.2), (13.9, 14.01))}, {'recovery_s': pytest.approx(3.01)}),  # late
    ({'spans_s': ((10.9, 11.2),)}, {'recovery_s': None}),  # no cycle began after the outage
    ({'spans_s': ((7.0, 7.1), (11.5, 11.6))}, {'during': 1}),  # bypassed the link
    ({'log': ''}, {'unreported': ('bs',)}), ({'warnings': REPORTED[:1]}, {'unreported': ('bs',)}),
    ({'log': 2 * LOG}, {'repeated': ('bs',)})])
def test_an_outage_fails_whose_end_is_late_or_whose_report_is_missing_or_repeated(
        changed, figures):
    result = outage(**changed)
    assert not result.passed
    assert figures.items() <= result.figures().items()
    assert json.dumps(result.figures(), allow_nan=False)


@pytest.mark.parametrize(('changed', 'unreported'), [
    ({'log': '', 'host': 'users'}, ()), ({'log': '', 'restored_s': 9.0}, ()),
    ({'restored_s': 27.0}, ()), ({'restored_s': 28.0}, ('user_1',)),
    ({'log': LOG + 'waiting for positioner\n'}, ())])
def test_users_miss_an_unreachable_node_later_than_the_base_station(changed, unreported):
    assert outage(**changed).unreported == unreported
