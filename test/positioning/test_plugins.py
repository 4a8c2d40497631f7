"""Estimators from other packages."""

from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.model import ElementErrors
from rhs_isac_ros.positioning import Estimate, EstimatorKind, make_estimator
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.plugins import PluginError
from rhs_isac_ros.system import System

CODE = '''
import numpy as np
from rhs_isac_ros.positioning import BayesEstimator, Estimate

class Centre:
    name = 'centre'

    def __init__(self, scenario, codebook, scale=1.0):
        self._estimate = Estimate(scale * np.array(scenario.roi_center_m), np.eye(3))

    def estimate(self, received):
        return self._estimate

class AnyOptions(Centre):
    def __init__(self, scenario, codebook, **options):
        self.options = options

class Mine(BayesEstimator):
    def __init__(self, system, *, weight=1.0, **options):
        super().__init__(system, **options)

def no_estimator(scenario, codebook):
    return None

class Nameless(Centre):
    name = None

bayes = Centre
'''


@pytest.fixture(autouse=True)
def installed(install):
    names = {'any_options': 'AnyOptions', 'mine': 'Mine', 'centre': 'Centre',
             'no_estimator': 'no_estimator', 'nameless': 'Nameless', 'bayes': 'Centre',
             'absent': 'Absent'}
    install('guesses', CODE, {plugins.ESTIMATORS: names})


def test_a_plug_in_is_created_by_its_name(small):
    estimator = make_estimator('centre', small.scenario, small.codebook)
    estimate = estimator.estimate(np.zeros((1, 6)))
    assert isinstance(estimate, Estimate)
    np.testing.assert_array_equal(estimate.mean, small.scenario.roi_center_m)
    doubled = make_estimator('centre', small.scenario, small.codebook, scale=2.0)
    np.testing.assert_array_equal(
        doubled.estimate(np.zeros((1, 6))).mean, 2 * np.array(small.scenario.roi_center_m))


def test_built_in_estimators_cannot_be_replaced(small):
    assert type(make_estimator('bayes', small.scenario, small.codebook)).__module__.startswith(
        'rhs_isac_ros.')


def test_the_error_for_an_unknown_name_lists_all_estimators(small):
    # Further plug-ins may be installed.
    with pytest.raises(ValueError, match=(
            r"estimator: 'best', expected one of \['absent', 'any_options', 'bayes', 'centre', "
            r"(.*, )?'ml', (.*, )?'nameless', (.*, )?'neural', (.*, )?'no_estimator'")):
        make_estimator('best', small.scenario, small.codebook)


@pytest.mark.slow
@pytest.mark.parametrize(('name', 'options', 'message'), [
    ('absent', {}, 'absent = guesses:Absent of guesses: cannot be loaded: AttributeError'),
    ('no_estimator', {},
     'no_estimator = guesses:no_estimator of guesses: returned None, expected an object'),
    ('centre', {'table': 1}, 'centre = guesses:Centre of guesses: failed: TypeError: .*table'),
])
def test_the_error_for_an_invalid_plug_in_names_its_entry_point(small, name, options, message):
    with pytest.raises(PluginError, match=f'entry point {plugins.ESTIMATORS}: {message}'):
        make_estimator(name, small.scenario, small.codebook, **options)
    with pytest.raises(PluginError, match='nameless: name None, expected a string'):
        make_estimator('nameless', small.scenario, small.codebook)


OFFERED = {'table_folder': Path('t'), 'reject_outside': True, 'scale': 2.0}


@pytest.mark.parametrize(('name', 'model', 'options'), [
    ('bayes', 'm', {'table_folder': Path('t'), 'reject_outside': True}),
    ('ml', '', {'table_folder': Path('t'), 'reject_outside': True}),
    ('neural', 'm', {'model_file': 'm'}), ('centre', 'm', {'scale': 2.0}),
    ('any_options', '', {}), ('any_options', 'm', {'model_file': 'm'})])
def test_an_estimator_is_offered_the_options_that_it_declares(name, model, options):
    assert EstimatorKind(name).accepted(model_file=model, **OFFERED) == options


def test_a_plug_in_may_declare_what_a_class_of_the_package_does(small):
    declared = {name: EstimatorKind(name) for name in (
        'bayes', 'neural', 'centre', 'any_options', 'mine')}
    assert [name for name, kind in declared.items() if kind.uses_tracks] == ['bayes', 'mine']
    assert [name for name, kind in declared.items() if not kind.uses_surface] == [
        'neural', 'centre']
    assert [name for name, kind in declared.items() if kind.readers] == ['neural']
    system = System(small.scenario, small.codebook)
    assert declared['mine'].create(system, reject_outside=True, weight=3.0).system is system


def test_a_plug_in_with_a_scenario_gets_a_known_surface_as_an_option(small):
    surface = ElementErrors(np.ones(16), np.full(16, np.nan))
    assert make_estimator('any_options', small.scenario, small.codebook, surface=surface
                          ).options == {'surface': surface}
