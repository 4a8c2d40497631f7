"""Training of the paper's network: 10^5 simulated pairs, split 7 : 1.5 : 1.5.

What the paper leaves open is chosen here: 512 rectified hidden units, the squared error in metres
as the loss, Adam with a step of 10^-3 and batches of 256 pairs, stopped when the validation error
has not fallen for some epochs; the weights of the best epoch count.
"""

import copy
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.positioning.network import Network, real_parts
from rhs_isac_ros.positioning.simulate import simulate_pairs
from rhs_isac_ros.positioning.whitened import WhitenedModel

DEFAULT_PAIRS = 100_000
DEFAULT_HIDDEN = 512
DEFAULT_EPOCHS = 100
_BATCH = 256
_STEP = 1e-3
_PATIENCE = 8
# Shares of the pairs for training and validation; the rest is the test.
_TRAINING, _VALIDATION = 0.7, 0.15


class Epoch(NamedTuple):
    """How far a training has come.

    Attributes
    ----------
    number
        Epochs done.
    validation_mse_m2
        Mean squared error of the validation pairs [m^2].
    best_mse_m2
        The least so far [m^2].
    elapsed_s
        Time since the simulation began [s].
    """

    number: int
    validation_mse_m2: float
    best_mse_m2: float
    elapsed_s: float


def train(
        scenario: Scenario, codebook: Codebook, n_pairs: int = DEFAULT_PAIRS, seed: int = 0,
        n_hidden: int = DEFAULT_HIDDEN, max_epochs: int = DEFAULT_EPOCHS,
        progress: Callable[[Epoch], None] | None = None) -> Network:
    """Train a network for a scenario and codebook.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.
    n_pairs
        Pairs of positions and received signals, all together; at least 20.
    seed
        Seeds the pairs, the first weights, and the order of the pairs.
    n_hidden
        Units of the hidden layer.
    max_epochs
        Passes through the training pairs at most.
    progress
        Called after every epoch.

    Returns
    -------
    Network
        The network of the epoch with the least validation error.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    ValueError
        If a number is too small, or scikit-learn is not installed.
    """
    for name, value, least in (('n_pairs', n_pairs, 20), ('n_hidden', n_hidden, 1),
                               ('max_epochs', max_epochs, 1)):
        if value < least:
            raise ValueError(f'{name}: {value}, expected at least {least}')
    begin = time.monotonic()
    regressor = _regressor(n_hidden, n_pairs, seed)
    positions, received = simulate_pairs(scenario, codebook, n_pairs, seed)
    first, second = int(_TRAINING * n_pairs), int((_TRAINING + _VALIDATION) * n_pairs)
    parts, center = real_parts(received), scenario.roi_bounds_m.mean(axis=0)
    mean, scale = parts[:first].mean(axis=0), parts[:first].std(axis=0)
    # One unit for all coordinates, so that the loss is the squared error.
    unit = np.sqrt(np.mean((positions[:first] - center)**2))
    inputs = ((parts - mean) / scale).astype(np.float32)
    targets = ((positions - center) / unit).astype(np.float32)

    def residuals(subset: slice) -> np.ndarray:
        return (regressor.predict(inputs[subset]) - targets[subset]).astype(float) * unit

    best, best_mse, best_epoch = None, np.inf, 0
    for number in range(1, max_epochs + 1):
        regressor.partial_fit(inputs[:first], targets[:first])
        mse = float(np.mean(np.sum(residuals(slice(first, second))**2, axis=1)))
        if mse < best_mse:
            best, best_mse, best_epoch = copy.deepcopy(
                (regressor.coefs_, regressor.intercepts_)), mse, number
        if progress:
            progress(Epoch(number, mse, best_mse, time.monotonic() - begin))
        if number - best_epoch >= _PATIENCE:
            break
    regressor.coefs_, regressor.intercepts_ = best
    errors, tests = residuals(slice(first, second)), residuals(slice(second, None))
    (w_in, w_out), (b_in, b_out) = (
        [array.astype(float) for array in arrays] for arrays in best)
    return Network(
        input_mean=mean, input_scale=scale, w_in=w_in, b_in=b_in, w_out=w_out * unit,
        b_out=b_out * unit, center=center, covariance=errors.T @ errors / len(errors),
        loudest=_loudest(scenario, codebook, positions), about={
            'codebook': codebook.id, 'scenario': scenario.changes(), 'seed': seed,
            'pairs': n_pairs, 'epochs': best_epoch, 'version': __version__,
            'validation_mse_m2': best_mse,
            'test_mse_m2': float(np.mean(np.sum(tests**2, axis=1)))})


def _regressor(n_hidden: int, n_pairs: int, seed: int) -> Any:
    try:
        from sklearn.neural_network import MLPRegressor
    except ImportError:
        raise ValueError('training needs scikit-learn, which is not installed '
                         '(pip install scikit-learn)') from None
    state = int(streams.generator(seed, streams.TRAINING).integers(2**32))
    return MLPRegressor(
        hidden_layer_sizes=(n_hidden,), activation='relu', solver='adam', alpha=0.0,
        learning_rate_init=_STEP, batch_size=min(_BATCH, int(_TRAINING * n_pairs)),
        random_state=state)


def _loudest(scenario: Scenario, codebook: Codebook, positions: np.ndarray) -> float:
    model = WhitenedModel(scenario, codebook)
    return float(np.sum(np.abs(model.mean(positions))**2, axis=(1, 2)).max())
