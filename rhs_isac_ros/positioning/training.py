"""Training of the paper's network: 10^5 simulated pairs, split 7 : 1.5 : 1.5.

The "256 nodes" that the paper mentions in its description of Fig. 4 are read as the units of the
hidden layer. The paper does not specify the rest. This implementation uses the real and imaginary
parts of the signals or their magnitudes as inputs, the ReLU activation, the squared position error
as the loss, and Adam with a learning rate of 10^-3. When the validation error has not decreased
for some epochs, the batch size grows, which reduces the noise of the steps. Training stops after
the largest batches, and the weights of the best epoch are used.
"""

import copy
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning.network import INPUTS, Network
from rhs_isac_ros.positioning.simulate import simulate_pairs
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.optional import optional_import
from rhs_isac_ros.support.threads import one_blas_thread

DEFAULT_PAIRS = 100_000
DEFAULT_HIDDEN = 256
DEFAULT_EPOCHS = 150
_BATCH_SIZES = (128, 1024, 8192)
_LEARNING_RATE = 1e-3
# Epochs without improvement before the batch size grows.
_PATIENCE_EPOCHS = 4
# Per cent of the pairs for training and validation; the rest is the test.
_TRAINING_PERCENT, _VALIDATION_PERCENT = 70, 15


class Epoch(NamedTuple):
    """Progress of a training after `number` epochs.

    The best error is the smallest validation error so far; the time includes the simulation.
    """

    number: int
    validation_mse_m2: float
    best_mse_m2: float
    elapsed_s: float


# One thread: more threads change the rounding and do not speed up such small products.
@one_blas_thread
def train(
        scenario: Scenario, codebook: Codebook, n_pairs: int = DEFAULT_PAIRS, seed: int = 0,
        n_hidden: int = DEFAULT_HIDDEN, max_epochs: int = DEFAULT_EPOCHS,
        progress: Callable[[Epoch], None] | None = None, inputs: str = 'parts') -> Network:
    """Train a network for a scenario and codebook.

    Returns the network of the epoch with the smallest validation error.

    Parameters
    ----------
    n_pairs
        Total number of pairs of positions and received signals, at least 20.
    seed
        Seed of the pairs, the initial weights and the order of the pairs.
    n_hidden
        Units of the hidden layer.
    progress
        Called after every epoch.
    inputs
        One of `INPUTS`: ``parts``, the real and imaginary parts of the signals, or
        ``magnitudes``.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    ValueError
        If a number is too small, or the inputs are unknown.
    MissingLibraryError
        If scikit-learn is not installed.
    """
    for name, value, minimum in (('n_pairs', n_pairs, 20), ('n_hidden', n_hidden, 1),
                                 ('max_epochs', max_epochs, 1)):
        if value < minimum:
            raise ValueError(f'{name}: {value}, expected at least {minimum}')
    if inputs not in INPUTS:
        raise ValueError(f'inputs: {inputs!r}, expected one of {sorted(INPUTS)}')
    start_s = time.monotonic()
    regressor = _regressor(n_hidden, seed)
    positions, received = simulate_pairs(scenario, codebook, n_pairs, seed)
    training, validation, test = _split(n_pairs)
    features, center = INPUTS[inputs](received), scenario.roi_bounds_m.mean(axis=0)
    mean, scale = features[training].mean(axis=0), features[training].std(axis=0)
    # One unit for all coordinates, so that the loss is the squared error.
    unit_m = np.sqrt(np.mean((positions[training] - center)**2))
    scaled = ((features - mean) / scale).astype(np.float32)
    targets = ((positions - center) / unit_m).astype(np.float32)

    def residuals(subset: slice) -> np.ndarray:
        errors: np.ndarray = regressor.predict(scaled[subset]) - targets[subset]
        return errors.astype(float) * unit_m

    def after_epoch(number: int, best_mse: float) -> float:
        mse = _mean_square(residuals(validation))
        if progress:
            progress(Epoch(number, mse, min(mse, best_mse), time.monotonic() - start_s))
        return mse

    best_epoch, best_mse = _fit(
        regressor, scaled[training], targets[training], max_epochs, after_epoch)
    errors, test_errors = residuals(validation), residuals(test)
    (w_in, w_out), (b_in, b_out) = (
        [array.astype(float) for array in arrays]
        for arrays in (regressor.coefs_, regressor.intercepts_))
    return Network(
        input_mean=mean, input_scale=scale, w_in=w_in, b_in=b_in, w_out=w_out * unit_m,
        b_out=b_out * unit_m, center=center, inputs=inputs,
        covariance=errors.T @ errors / len(errors),
        max_energy=_max_energy(scenario, codebook, positions), about={
            'codebook': codebook.id, 'scenario': scenario.changes(), 'seed': seed,
            'pairs': n_pairs, 'epochs': best_epoch, 'version': __version__,
            'validation_mse_m2': best_mse, 'test_mse_m2': _mean_square(test_errors)})


def _split(n_pairs: int) -> tuple[slice, slice, slice]:
    """Return the pairs for training, validation and test."""
    first = n_pairs * _TRAINING_PERCENT // 100
    second = n_pairs * (_TRAINING_PERCENT + _VALIDATION_PERCENT) // 100
    return slice(first), slice(first, second), slice(second, None)


def _fit(
        regressor: Any, inputs: np.ndarray, targets: np.ndarray, max_epochs: int,
        after_epoch: Callable[[int, float], float]) -> tuple[int, float]:
    """Train up to `max_epochs` epochs, restore the best weights, return their epoch and error.

    `after_epoch` takes an epoch's number and the smallest error so far, and returns the epoch's
    error.
    """
    best_weights: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    best_mse, best_epoch, reference_epoch = np.inf, 0, 0
    sizes = [min(size, len(inputs)) for size in _BATCH_SIZES]
    regressor.set_params(batch_size=sizes.pop(0))
    for number in range(1, max_epochs + 1):
        regressor.partial_fit(inputs, targets)
        mse = after_epoch(number, best_mse)
        if mse < best_mse:
            best_weights = copy.deepcopy((regressor.coefs_, regressor.intercepts_))
            best_mse, best_epoch, reference_epoch = mse, number, number
        if number - reference_epoch >= _PATIENCE_EPOCHS:
            if not sizes:
                break
            regressor.set_params(batch_size=sizes.pop(0))
            reference_epoch = number
    regressor.coefs_, regressor.intercepts_ = best_weights
    return best_epoch, best_mse


def _regressor(n_hidden: int, seed: int) -> Any:
    """Return the untrained network."""
    with optional_import('training', extra='neural'):
        from sklearn.neural_network import MLPRegressor
    state = int(streams.generator(seed, streams.TRAINING).integers(2**32))
    regressor = MLPRegressor(
        hidden_layer_sizes=(n_hidden,), activation='relu', solver='adam', alpha=0.0,
        learning_rate_init=_LEARNING_RATE, random_state=state)
    return regressor


def _mean_square(errors: np.ndarray) -> float:
    return float(np.mean(np.sum(errors**2, axis=1)))


def _max_energy(scenario: Scenario, codebook: Codebook, positions: np.ndarray) -> float:
    model = MeasurementModel(scenario, codebook)
    return float(np.sum(np.abs(model.whiten(model.mean(positions)))**2, axis=(1, 2)).max())
