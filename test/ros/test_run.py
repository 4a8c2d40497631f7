"""Parameters on the command lines of the executables, and their descriptions."""

import argparse

import pytest

from rhs_isac_ros.ros.parameters import CODEBOOK
from rhs_isac_ros.ros.run import check_parameters, parameter_help


@pytest.mark.parametrize(('words', 'reason'), [
    (['--ros-args', '-p', 'polcy:=random'], 'polcy: unknown parameter'),
    (['--ros-args', '-r', 'beacon:=b', '--param', 'estimator:=ml'],
     'estimator is a parameter of positioner, expected one of bs'),
])
def test_a_parameter_that_an_executable_does_not_have_is_an_error(words, reason, capsys):
    with pytest.raises(SystemExit, match='2'):
        check_parameters(argparse.ArgumentParser(prog='bs'), 'bs', words)
    assert f'bs: error: argument -p: {reason}' in capsys.readouterr().err


@pytest.mark.parametrize('words', [
    ['--ros-args', '-p', 'policy:=random', '-p', 'use_sim_time:=true'],
    ['--ros-args', '-p', 'bs_2:polcy:=random'],
    ['-p', 'polcy:=random', '--ros-args', '-r', 'polcy:=b', '--', '-p', 'polcy:=random'],
], ids=['own parameters', 'of a single node', 'outside of the ROS arguments'])
def test_other_arguments_are_accepted(words):
    check_parameters(argparse.ArgumentParser(), 'bs', words)


def test_only_the_optimizer_describes_the_parameters_of_a_codebook():
    lines = {name: parameter_help(name).splitlines() for name in ('optimizer', 'bs', 'network')}
    for parameter in CODEBOOK:
        assert f'  {parameter}' in lines['optimizer']
        assert f'  {parameter}' not in lines['bs'] + lines['network']
