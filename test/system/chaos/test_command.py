"""``scripts/chaos`` on a small network: a short run of each test."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from forked import Forked

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.environment import claim_domain
from rhs_isac_ros.ros.roster import UNIQUE
from system.chaos import fuzzing
from system.chaos.command import main
from system.chaos.crashes import CrashTrial
from system.chaos.fuzzing import FuzzResult
from system.chaos.mutations import mutate
from system.chaos.soaking import SoakResult
from system.chaos.trial import ChaosError
from system.trial_processes import TrialProcesses


def spawn(processes, name):
    """Start a process as a copy of one that has imported its executable."""
    log = processes._logs / f'{name}.log'
    log.touch()
    processes._running[name] = Forked(
        processes._commands[name], log, processes._environment)


@pytest.fixture
def chaos(small_files, monkeypatch, capfd):
    """Function that runs the command on a small network; returns its figures and its output."""
    monkeypatch.setattr(TrialProcesses, '_spawn', spawn)

    def chaos(*arguments):
        with mock.patch.dict(os.environ, ROS_DOMAIN_ID=claim_domain()):
            code = main(['--config', str(small_files / 'scenario.yaml'),
                         '--codebook', str(small_files / 'first.yaml'), *arguments])
        output, errors = capfd.readouterr()
        assert output, errors
        figures = json.loads(output)
        assert code == (0 if figures['passed'] else 1), output + errors
        return figures, output + errors
    return chaos


def test_cycles_are_served_after_a_crash_and_a_second_base_station(chaos):
    """The older of two base stations resumes when the newer has gone."""
    figures, output = chaos('--nodes', 'rhs_controller', '--phases', 'positioning',
                            '--intruders', 'bs', '--seconds', '1')
    assert figures['trials'] == 2
    assert figures['wrong_publications'] == 0, output
    assert figures['checked_publications'] > figures['unverified_publications']
    crash, intrusion = figures['table']
    assert (crash['node'], crash['phase']) == ('rhs_controller', 'positioning')
    assert intrusion['intruder'] == 'bs'
    # The time to recover depends on the load of the machine; recovery itself does not.
    for trial in figures['table']:
        assert trial['others_running']
        assert trial['recovery_s'] is not None, output
        # Nodes of a busy machine may fall silent, and be reported, twice.
        assert trial['logged'] and trial['diagnosed'], output


def test_mutations_crash_no_node_and_are_counted(chaos):
    figures, output = chaos('--fuzz', '300')
    assert figures['passed'], output
    assert sum(figures['sent'].values()) == 300
    assert figures['sent'].keys() == {
        *topics.NAMES.values(), topics.CODEBOOK, topics.PRESENCE, topics.POSITION,
        topics.DIAGNOSTICS, topics.MARKERS}
    # A third of the mutations is malformed.
    assert min(figures['counted'].values()) > 0
    assert figures['dropped']['malformed'] == sum(figures['malformed'].values())
    assert not figures['suspects']


def test_mutations_are_the_same_in_each_run(small):
    """Apart from the padding, in which rclpy leaves what the memory held before."""
    def read(kind, content):
        try:
            return repr(convert.from_bytes(kind, content))
        except m.MessageError as error:
            return str(error)

    def mutations():
        rng = np.random.default_rng(3)
        stored = fuzzing.originals(small.scenario, small.codebook, rng)
        return [read(kind, mutate(convert.ros_type(kind), stored[name], rng))
                for kind, name in topics.NAMES.items() for _ in range(20)]
    assert mutations() == mutations()


def test_the_bytes_that_cause_an_error_are_printed(monkeypatch, small):
    monkeypatch.setattr(convert, 'from_bytes', mock.Mock(side_effect=ZeroDivisionError))
    with pytest.raises(ChaosError, match=r'ZeroDivisionError\(\) from Beacon 0001ff'):
        fuzzing._is_malformed(m.Beacon, b'\0\1\xff', small.scenario)


def test_cycles_are_served_over_an_impaired_channel(chaos):
    figures, output = chaos('--soak', '0.03')
    assert figures['wrong_publications'] == 0, output
    # The number of cycles depends on the load of the machine.
    assert figures['cycles'] == sum(figures['outcomes'].values())
    assert not figures['ended']
    assert figures['memory_growth'].keys() == {*UNIQUE, 'user_1', 'user_2'}


@pytest.mark.parametrize('arguments', [
    ['--soak', '0'], ['--soak', 'inf'], ['--fuzz', '-3'], ['--soak', '1', '--fuzz', '1'],
    ['--composed', '--nodes', 'bs'], ['--composed', '--intruders', 'bs', 'user'],
    ['--nodes', 'unknown'], ['--intruders', 'unknown'], ['--phases', 'unknown']])
def test_invalid_arguments_are_rejected(arguments, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert 'error: argument' in capsys.readouterr().err


def test_an_invalid_file_is_named():
    done = subprocess.run(
        [sys.executable, '-m', 'system.chaos', '--config', '/nonexistent.yaml'],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert '/nonexistent.yaml' in done.stderr


# The verdicts

CRASH = CrashTrial(
    node='rhs_controller', phase='positioning', kill_delay_s=1e-3, recovery_s=2.5,
    others_running=True, logged=('bs: missing', 'user: missing'), diagnosed=('bs',),
    violations=())
FUZZ = FuzzResult(
    sent={'beacon': 5}, malformed={'bs': 3}, counted={'bs': 3}, dropped={'malformed': 3},
    ended=(), traces=(), recovery_s=0.5)
SOAK = SoakResult(
    minutes=10.0, outcomes={'served': 995, 'user_gone': 5}, estimates=996, retries={},
    impaired={}, memory_bytes={'bs': (100, 104)}, ended=())


@pytest.mark.parametrize(('changed', 'recovered', 'reported'), [
    ({}, True, True), ({'recovery_s': 3.01}, False, True), ({'recovery_s': None}, False, True),
    ({'others_running': False}, False, True), ({'logged': ()}, True, False),
    ({'diagnosed': ()}, True, False),
    ({'logged': (), 'diagnosed': (), 'has_others': False}, True, True),
    ({'logged': ('bs: missing',) * 2}, True, False)])
def test_a_trial_fails_if_recovery_is_late_a_process_ends_or_the_report_is_missing_or_repeated(
        changed, recovered, reported):
    trial = dataclasses.replace(CRASH, **changed)
    assert (trial.recovered, trial.reported) == (recovered, reported)


@pytest.mark.parametrize(('result', 'failures'), [
    (FUZZ, ({'counted': {'bs': 2}}, {'ended': ('bs',)}, {'traces': ('bs: Traceback',)})),
    (SOAK, ({'estimates': 989}, {'memory_bytes': {'bs': (100, 106)}}, {'ended': ('bs',)}))])
def test_fuzzing_and_soaking_fail_beyond_their_limits(result, failures):
    assert result.passed
    assert not any(dataclasses.replace(result, **changed).passed for changed in failures)
