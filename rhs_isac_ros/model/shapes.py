"""Checks of array shapes against the sizes of a scenario."""

import numpy as np

from rhs_isac_ros.model.scenario import Scenario


def check_shape(name: str, array: np.ndarray, symbols: str, scenario: Scenario) -> None:
    """Check the shape of an array against `symbols`: keys of `Scenario.sizes`, blanks between.

    Raises
    ------
    ValueError
        If the shape differs. The message gives the actual and the expected shape.
    """
    expected = tuple(scenario.sizes[symbol] for symbol in symbols.split())
    if np.shape(array) != expected:
        listed = ', '.join(symbols.split())
        raise ValueError(f'{name}: shape {np.shape(array)}, expected [{listed}] = {expected}')
