"""Training of the paper's network: 10^5 simulated pairs, split 7 : 1.5 : 1.5.

What the paper leaves open is chosen here: 512 rectified hidden units, the squared error in metres
as the loss, and Adam with a step of 10^-3. When the validation error has not fallen for some
epochs the batches grow, which calms the steps; after the largest ones training stops, and the
weights of the best epoch count.
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
DEFAULT_EPOCHS = 150
_BATCHES = (128, 1024, 8192)
_STEP = 1e-3
_PATIENCE = 4
# Per cent of the pairs for training and validation; the rest is the test.
_TRAINING, _VALIDATION = 70, 15


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
    regressor, limit_threads = _regressor(n_hidden, seed)
    positions, received = simulate_pairs(scenario, codebook, n_pairs, seed)
    first, second = n_pairs * _TRAINING // 100, n_pairs * (_TRAINING + _VALIDATION) // 100
    parts, center = real_parts(received), scenario.roi_bounds_m.mean(axis=0)
    mean, scale = parts[:first].mean(axis=0), parts[:first].std(axis=0)
    # One unit for all coordinates, so that the loss is the squared error.
    unit = np.sqrt(np.mean((positions[:first] - center)**2))
    inputs = ((parts - mean) / scale).astype(np.float32)
    targets = ((positions - center) / unit).astype(np.float32)

    def residuals(subset: slice) -> np.ndarray:
        return (regressor.predict(inputs[subset]) - targets[subset]).astype(float) * unit

    def after_epoch(number: int, best: float) -> float:
        mse = _mean_square(residuals(slice(first, second)))
        if progress:
            progress(Epoch(number, mse, min(mse, best), time.monotonic() - begin))
        return mse

    # One thread: more of them round otherwise, and hinder each other on such small products.
    with limit_threads(1):
        best_epoch, best_mse = _descend(
            regressor, inputs[:first], targets[:first], max_epochs, after_epoch)
    errors, tests = residuals(slice(first, second)), residuals(slice(second, None))
    (w_in, w_out), (b_in, b_out) = (
        [array.astype(float) for array in arrays]
        for arrays in (regressor.coefs_, regressor.intercepts_))
    return Network(
        input_mean=mean, input_scale=scale, w_in=w_in, b_in=b_in, w_out=w_out * unit,
        b_out=b_out * unit, center=center, covariance=errors.T @ errors / len(errors),
        loudest=_loudest(scenario, codebook, positions), about={
            'codebook': codebook.id, 'scenario': scenario.changes(), 'seed': seed,
            'pairs': n_pairs, 'epochs': best_epoch, 'version': __version__,
            'validation_mse_m2': best_mse, 'test_mse_m2': _mean_square(tests)})


def _descend(
        regressor: Any, inputs: np.ndarray, targets: np.ndarray, max_epochs: int,
        after_epoch: Callable[[int, float], float]) -> tuple[int, float]:
    """Fit epoch after epoch and leave the best weights; returns their epoch and error.

    `after_epoch` takes number and least error so far, and returns the epoch's.
    """
    best, best_mse, best_epoch, since = None, np.inf, 0, 0
    sizes = [min(size, len(inputs)) for size in _BATCHES]
    regressor.set_params(batch_size=sizes.pop(0))
    for number in range(1, max_epochs + 1):
        regressor.partial_fit(inputs, targets)
        mse = after_epoch(number, best_mse)
        if mse < best_mse:
            best = copy.deepcopy((regressor.coefs_, regressor.intercepts_))
            best_mse, best_epoch, since = mse, number, number
        if number - since >= _PATIENCE:
            if not sizes:
                break
            regressor.set_params(batch_size=sizes.pop(0))
            since = number
    regressor.coefs_, regressor.intercepts_ = best
    return best_epoch, best_mse


def _regressor(n_hidden: int, seed: int) -> tuple[Any, Any]:
    """Return the untrained network, and what limits the threads of its products."""
    try:
        from sklearn.neural_network import MLPRegressor
        from threadpoolctl import threadpool_limits
    except ImportError:
        raise ValueError('training needs scikit-learn, which is not installed '
                         '(pip install scikit-learn)') from None
    state = int(streams.generator(seed, streams.TRAINING).integers(2**32))
    regressor = MLPRegressor(
        hidden_layer_sizes=(n_hidden,), activation='relu', solver='adam', alpha=0.0,
        learning_rate_init=_STEP, random_state=state)
    return regressor, threadpool_limits


def _mean_square(errors: np.ndarray) -> float:
    return float(np.mean(np.sum(errors**2, axis=1)))


def _loudest(scenario: Scenario, codebook: Codebook, positions: np.ndarray) -> float:
    model = WhitenedModel(scenario, codebook)
    return float(np.sum(np.abs(model.mean(positions))**2, axis=(1, 2)).max())
