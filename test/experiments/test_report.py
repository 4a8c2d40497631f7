"""Statistics of trials as text."""

import math

import numpy as np
import pytest

from rhs_isac_ros.experiments import markdown_table, mean_and_std, plus_minus


def test_mean_and_std_are_those_of_a_sample():
    mean, std = mean_and_std([1.0, 2.0, 6.0])
    assert mean == 3.0
    assert std == pytest.approx(math.sqrt((4 + 1 + 9) / 2))


@pytest.mark.parametrize('values', [[2.0], [1.0, math.inf], [math.inf, math.inf]])
def test_an_undefined_deviation_is_nan(values):
    mean, std = mean_and_std(values)
    assert mean == np.mean(values)
    assert math.isnan(std)


@pytest.mark.parametrize(('mean', 'std', 'text'), [
    (0.04057, 0.00123, '0.0406 ± 0.0012'), (12.345, 0.5, '12.3 ± 0.5'), (1234.5, 7.0, '1234 ± 7'),
    (0.0, 0.0, '0.00 ± 0.00'), (-0.0512, math.nan, '-0.0512'), (math.inf, math.nan, 'inf')])
def test_mean_and_deviation_have_the_same_places(mean, std, text):
    assert plus_minus(mean, std) == text


def test_a_table_is_aligned_markdown():
    table = markdown_table(['method', 'm²'], [['direct', '1.5'], ['ga', '12.25']])
    assert table.splitlines() == [
        '| method |    m² |', '| ------ | ----: |', '| direct |   1.5 |', '| ga     | 12.25 |']


def test_rows_of_another_length_are_an_error():
    with pytest.raises(ValueError):
        markdown_table(['a', 'b'], [['1']])
