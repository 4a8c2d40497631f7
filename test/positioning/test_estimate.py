"""Checks of received signals."""

import numpy as np
import pytest

from rhs_isac_ros.positioning import SignalError
from rhs_isac_ros.positioning.estimate import checked_received


def test_one_phase_or_many_become_many(small):
    signals = np.arange(12).reshape(2, 1, 6)
    batch = checked_received(small.scenario, small.codebook, signals)
    assert batch.dtype == complex
    np.testing.assert_array_equal(batch, signals)
    one = checked_received(small.scenario, small.codebook, signals[1].tolist())
    np.testing.assert_array_equal(one, signals[1:])


@pytest.mark.parametrize('shape', [(6,), (1, 5), (2, 6), (6, 1), (1, 1, 1, 6), ()])
def test_another_shape_is_an_error_that_names_field_shape_and_expectation(small, shape):
    with pytest.raises(SignalError) as caught:
        checked_received(small.scenario, small.codebook, np.zeros(shape))
    message = str(caught.value)
    assert message.startswith(f'received: shape {shape}, expected [N_B, N_SB F] = (1, 6)')


@pytest.mark.parametrize('value', [np.nan, np.inf, 1j * np.nan])
def test_a_value_that_is_not_finite_is_an_error(small, value):
    signals = np.zeros((3, 1, 6), complex)
    signals[1, 0, 4] = value
    with pytest.raises(SignalError, match='^received: not finite, expected finite signals'):
        checked_received(small.scenario, small.codebook, signals)
