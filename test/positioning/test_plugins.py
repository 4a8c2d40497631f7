"""Estimators from other packages."""

from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.positioning import Estimate, file_options, make_estimator
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.plugins import PluginError

CODE = '''
import numpy as np
from rhs_isac_ros.positioning import Estimate

class Centre:
    name = 'centre'

    def __init__(self, scenario, codebook, scale=1.0):
        self._estimate = Estimate(scale * np.array(scenario.roi_center_m), np.eye(3))

    def estimate(self, received):
        return self._estimate

def no_estimator(scenario, codebook):
    return None

class Nameless(Centre):
    name = None

bayes = Centre
'''


@pytest.fixture(autouse=True)
def installed(install):
    names = {'centre': 'Centre', 'no_estimator': 'no_estimator', 'nameless': 'Nameless',
             'bayes': 'Centre', 'absent': 'Absent'}
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
            r"estimator: 'best', expected one of \['absent', 'bayes', 'centre', (.*, )?'ml', "
            r"(.*, )?'nameless', (.*, )?'neural', (.*, )?'no_estimator'")):
        make_estimator('best', small.scenario, small.codebook)


@pytest.mark.parametrize(('name', 'options', 'message'), [
    ('absent', {}, 'absent = guesses:Absent of guesses: cannot be loaded: AttributeError'),
    ('no_estimator', {},
     'no_estimator = guesses:no_estimator of guesses: returned None, expected an object'),
    ('nameless', {}, r'nameless = guesses:Nameless of guesses: returned <.*>, expected an object'),
    ('centre', {'table': 1}, 'centre = guesses:Centre of guesses: failed: TypeError: .*table'),
])
def test_the_error_for_an_invalid_plug_in_names_its_entry_point(small, name, options, message):
    with pytest.raises(PluginError, match=f'entry point {plugins.ESTIMATORS}: {message}'):
        make_estimator(name, small.scenario, small.codebook, **options)


@pytest.mark.parametrize(('name', 'model', 'options'), [
    ('bayes', '', {'table_folder': Path('t')}), ('bayes', 'm', {'table_folder': Path('t')}),
    ('ml', '', {'table_folder': Path('t')}), ('neural', '', {'model_file': ''}),
    ('neural', 'm', {'model_file': 'm'}), ('centre', '', {}),
    ('centre', 'm', {'model_file': 'm'})])
def test_file_options_depend_on_the_estimator(name, model, options):
    assert file_options(name, Path('t'), model) == options
