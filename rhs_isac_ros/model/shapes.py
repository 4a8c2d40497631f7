"""Checking arrays against the sizes of a scenario."""

import numpy as np

from rhs_isac_ros.model.scenario import Scenario


def check_shape(name: str, array: np.ndarray, symbols: str, scenario: Scenario) -> None:
    """Check that an array has the sizes of a scenario.

    Parameters
    ----------
    name
        What to call it in an error.
    array
        The array.
    symbols
        Its dimensions, symbols of `Scenario.sizes` with blanks between them.
    scenario
        The scenario.

    Raises
    ------
    ValueError
        If the shape is another one; the text names it and what was expected.
    """
    expected = tuple(scenario.sizes[symbol] for symbol in symbols.split())
    if np.shape(array) != expected:
        listed = ', '.join(symbols.split())
        raise ValueError(f'{name}: shape {np.shape(array)}, expected [{listed}] = {expected}')
