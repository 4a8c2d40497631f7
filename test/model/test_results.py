"""What the methods of users' objects return: it is checked where it enters the package."""

import re

import numpy as np
import pytest

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Impairment, Linear, Scenario, mobility
from rhs_isac_ros.model.board import Board, BoardError
from rhs_isac_ros.model.elementwise import Elementwise
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.surface import ports_of
from rhs_isac_ros.positioning import Estimate, estimate_each
from rhs_isac_ros.positioning.estimate import estimate_of
from rhs_isac_ros.support import plugins
from rhs_isac_ros.system import System

SIZES = {'elements_per_side': 4, 'n_subbands': 3, 'n_frames': 2}
SCENARIO = Scenario(**SIZES)
CODEBOOK = random_codebook(SCENARIO, np.random.default_rng(0))
PORTS = ports_of(SCENARIO)
WRONG = {
    'nothing': lambda good: None, 'a text': lambda good: 'x', 'objects': lambda good: [good, {}],
    'another size': lambda good: good[..., :-1], 'another axis': lambda good: good[None, None],
    'not finite': lambda good: np.nan * good, 'masked': np.ma.array}


def own(base, **results):
    """Return a class whose methods return these results, or those of these functions."""
    return type('Own', base, {'kind': 'own', '__init__': lambda self, *_: None, **{
        name: lambda *_, result=result: result() if callable(result) else result
        for name, result in results.items()}})


def board(base, name, result):
    methods = dict.fromkeys(base.__abstractmethods__) | {name: result}
    return getattr(own((base,), **methods)(), name)(PORTS, CODEBOOK.analog)


def sample(**parts):
    """Sample signals with an impairment."""
    linear = parts.get('linear') or Linear(
        parts.get('patterns', np.ones((1, 2, 6))), parts.get('root', np.eye(1)))
    kind = own((Impairment,), linear=linear, values=parts.get('values', np.zeros((1, 1))))
    scenario = Scenario(**SIZES, impairments={kind: 1.0})
    return System(scenario, CODEBOOK).sample([[8.0, 0, 0]], np.random.default_rng(0))


def move(**results):
    user = mobility.make_plugin(own((), **results), SCENARIO, 1.0, np.random.default_rng(0))
    return mobility.Crowd([user]).states(0.0)


def locate(mean, covariance):
    return estimate_each(CODEBOOK, np.ones((2, 6)), lambda _: [Estimate(mean, covariance)])


# A valid result, and a function that uses it, by the name in errors.
RESULTS = {
    'Own.transfer': (np.ones((2, 3, 2, 16, 3)), lambda x: board(Board, 'transfer', x)),
    'Own.pullback': (np.ones((2, 2, 16)), lambda x: board(Board, 'pullback', x)),
    'Own.coefficients': (
        np.ones((2, 1, 2, 16)), lambda x: board(Elementwise, 'coefficients', x)),
    'Own.slopes': (np.ones((2, 3, 2, 16)), lambda x: board(Elementwise, 'slopes', x)),
    'Own.paths': (np.ones((2, 3, 3, 16)), lambda x: board(Board, 'paths', x)),
    'Own.channels': (np.ones((2, 3, 2, 3, 16)), lambda x: board(Board, 'channels', x)),
    'Own.radiation': (np.ones((2, 3, 2, 16)), lambda x: board(Elementwise, 'radiation', x)),
    'Own.feeds': (np.ones((2, 3, 2, 3)), lambda x: board(Elementwise, 'feeds', x)),
    'Own.by_tunings': (np.ones((2, 2, 16)), lambda x: board(Board, 'by_tunings', x)),
    'Own.by_digital': (np.ones((2, 3, 2, 3)), lambda x: board(Board, 'by_digital', x)),
    'Own.focused': (np.ones(16), lambda x: board(Elementwise, 'focused', x)),
    'Own: patterns': (np.ones((1, 2, 6)), lambda x: sample(patterns=x)),
    'Own: root': (np.eye(1), lambda x: sample(root=x)),
    'Own.values': (np.zeros((1, 1)), lambda x: sample(values=x)),
    'Own.state': (np.ones((2, 3)), lambda x: move(state=x)),
    'Own.leg': (np.ones(3), lambda x: move(state=None, leg=mobility.Leg(x, x, 0.0, 1.0))),
    'mean': (np.ones(3), lambda x: locate(x, np.eye(3))),
    'covariance': (np.eye(3), lambda x: locate(np.ones(3), x)),
    '<function': (np.ones(4097), lambda x: GainPattern(lambda angles: x)),
    'signals': (np.ones((2, 6)), System(SCENARIO, CODEBOOK).whiten)}
# What is valid: signals on further axes, and positions that are not known.
VALID = {'signals': {'another axis', 'not finite'}, 'mean': {'not finite'},
         'covariance': {'not finite'}}


@pytest.mark.parametrize(('name', 'use'), [
    *((name, use) for name, (_, use) in RESULTS.items() if name.startswith('Own.')
      and name != 'Own.leg'), ('Own.leg', lambda x: move(state=None, leg=x)),
    ('Own.linear', lambda x: sample(linear=x)),
    ('Own.estimate', lambda x: estimate_of(own((), estimate=x)(), np.ones((2, 6))))])
def test_what_a_method_raises_is_the_cause_of_an_error_that_names_it(name, use):
    def fail():
        raise KeyError('boom')
    with pytest.raises(plugins.PluginError, match=f"^{name}: KeyError: 'boom'$") as caught:
        use(fail)
    assert "raise KeyError('boom')" in plugins.trace_of(caught.value.__cause__)


def test_tunings_of_a_focused_beam_are_from_0_to_1():
    with pytest.raises(BoardError, match='^Own.focused: -1 to -1, expected tunings from 0 to 1'):
        board(Elementwise, 'focused', -np.ones(16))


@pytest.mark.parametrize('name', ['velocity', 'residual', 'is_predicted', 'cross_covariance'])
def test_numbers_of_an_estimate_have_the_sizes_of_its_positions(name):
    for wrong in ('x', np.ones(2), None):
        found = Estimate(np.ones(3), np.eye(3), **{name: wrong})
        with pytest.raises(plugins.PluginError, match=f'^Own.estimate: {name}: .*expected'):
            estimate_of(own((), estimate=found)(), np.ones((2, 6)))


@pytest.mark.parametrize(('n', 'found'), [
    ((), None), ((), Estimate(np.ones((1, 3)), np.ones((1, 3, 3)))), ((1,), np.ones((1, 3))),
    ((1,), Estimate(np.ones(3), np.eye(3))), ((0,), Estimate(np.ones((1, 3)), np.eye(3)[None]))])
def test_an_estimator_returns_an_estimate_for_each_shot(n, found):
    shape = re.escape(str([*n, 3]))
    with pytest.raises(plugins.PluginError, match=f'^Own.estimate: .* with means {shape}'):
        estimate_of(own((), estimate=found)(), np.ones((*n, 2, 6)))


@pytest.mark.parametrize('name', RESULTS)
def test_results_of_a_wrong_shape_or_type_are_errors_that_name_them(name):
    good, use = RESULTS[name]
    use(good)
    for kind in WRONG.keys() - VALID.get(name, set()):
        with pytest.raises(ValueError, match=f'^{name}.*: .*expected '):
            use(WRONG[kind](good))
