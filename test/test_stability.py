"""The names of ``docs/stability.rst`` exist, and the examples in their docstrings hold."""

import doctest
import re
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros import calibration, model

PAGE = Path(__file__).parents[1] / 'docs' / 'stability.rst'
IMPORTS = re.findall(r'^ +(from rhs_isac_ros\S* import .+)$', PAGE.read_text(), re.M)
NAMES: dict = {}
exec('\n'.join(IMPORTS), NAMES)
del NAMES['__builtins__']


def test_the_page_lists_the_stable_names():
    assert set(NAMES) == {
        'Codebook', 'Scenario', 'System', 'average_crlb', 'capacity', 'crlb',
        'default_codebook_file', 'make_estimator', 'optimize', 'simulate_received', 'steer'}


@pytest.mark.parametrize('name', sorted(NAMES))
def test_an_example_uses_only_stable_names(name):
    check_example(NAMES[name], NAMES)


@pytest.mark.parametrize('kind', [
    calibration.Pilots, model.MeasurementModel, model.PathChannel, model.Pose])
def test_examples_of_further_classes_hold(kind):
    check_example(kind, {**vars(model), **vars(calibration), **NAMES})


def check_example(subject, names):
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(subject, subject.__name__, globs={**names, 'np': np})
    assert example.examples, 'the docstring has no example'
    report = []
    doctest.DocTestRunner(verbose=False).run(example, out=report.append)
    assert not report, ''.join(report)
