"""The paper's estimator: a network with one hidden layer, its file, its use and its training.

The paper mentions "256 nodes" in its description of Fig. 4; they are taken to be the units of the
hidden layer. The paper does not specify the rest. Here, the inputs are the real and imaginary
parts of the signals, or their magnitudes. The activation is ReLU, the loss is the squared position
error, and the optimiser is Adam with a learning rate of 10^-3. The simulated pairs, 10^5 by
default, are split 7 : 1.5 : 1.5 for training, validation and test. If the validation error has not
decreased for some epochs, the batch size grows, which reduces the noise of the steps. Training
stops after the largest batches or the last epoch, and the weights of the best epoch are used.
"""

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import check_arrays, numbers
from rhs_isac_ros.positioning.diagnosis import FitTest
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import whole
from rhs_isac_ros.support.files import ArchiveError, read_archive, read_once, write_archive
from rhs_isac_ros.support.optional import optional_import
from rhs_isac_ros.support.threads import one_blas_thread
from rhs_isac_ros.system import System

DEFAULT_PAIRS = 100_000
DEFAULT_HIDDEN = 256
DEFAULT_EPOCHS = 150
_BATCH_SIZES = (128, 1024, 8192)
_LEARNING_RATE = 1e-3
# Epochs without improvement before the batch size grows.
_PATIENCE_EPOCHS = 4
# Percentages of the pairs at which the validation set and the test set begin.
_VALIDATION_PERCENT, _TEST_PERCENT = 70, 85
_FORMAT = 1
# Arrays of a network with D inputs and H hidden units.
_SHAPES = {'input_mean': 'D', 'input_scale': 'D', 'w_in': 'DH', 'b_in': 'H', 'w_out': 'H3',
           'b_out': '3', 'center': '3', 'covariance': '33', 'max_energy': ''}
# Keys of these arrays in the file.
_KEYS = {name: 'loudest' if name == 'max_energy' else name for name in _SHAPES}


def stack_parts(signals: np.ndarray) -> np.ndarray:
    """Flatten complex signals to float64 [N, 2 N_B N_SB F], all real parts first."""
    flat = _flat(signals)
    return np.hstack([flat.real, flat.imag])


def _flat(signals: np.ndarray) -> np.ndarray:
    # The second number cannot be left to NumPy, because there may be no signals.
    return signals.reshape(len(signals), math.prod(signals.shape[1:]))


# Inputs of a network as functions of the received signals. The paper does not specify them.
INPUTS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    'parts': stack_parts, 'magnitudes': lambda signals: np.abs(_flat(signals))}


class ModelError(ValueError):
    """A trained model is missing or invalid, or belongs to another codebook or scenario."""


@dataclasses.dataclass(frozen=True, eq=False)
class Network:
    """A trained network, with the arguments and results of its training.

    The input x consists of the real and imaginary parts of the received signals,
    D = 2 N_B N_SB F, or of their magnitudes, D = N_B N_SB F, each scaled to zero mean and unit
    variance. The position is p = center + w_out^T max(0, w_in^T x + b_in) + b_out, in metres.
    """

    input_mean: np.ndarray  #: Mean of the inputs in training, float64 [D].
    input_scale: np.ndarray  #: Standard deviation of the inputs in training, float64 [D].
    w_in: np.ndarray  #: Weights of the hidden layer, float64 [D, H].
    b_in: np.ndarray  #: Biases of the hidden layer, float64 [H].
    w_out: np.ndarray  #: Weights of the output, float64 [H, 3] [m].
    b_out: np.ndarray  #: Biases of the output, float64 [3] [m].
    center: np.ndarray  #: Centre of the region of interest, float64 [3] [m].
    covariance: np.ndarray  #: Second moments of the validation residuals, float64 [3, 3] [m^2].
    max_energy: float  #: Largest energy of a whitened mean signal over the simulated positions.
    #: ``codebook``, its id; ``scenario``, the fields that differ from Table I; ``epochs``, the
    #: best epoch; ``seed``, ``pairs``, ``version``; ``validation_mse_m2`` and ``test_mse_m2``.
    about: dict[str, Any]
    inputs: str = 'parts'  #: One of `INPUTS`.

    def __post_init__(self) -> None:
        """Check that the inputs are known, sizes agree and numbers are finite."""
        if self.inputs not in INPUTS:
            raise ModelError(f'inputs: {self.inputs!r}, expected one of {sorted(INPUTS)}')
        n_inputs, n_hidden = np.shape(self.w_in) if np.ndim(self.w_in) == 2 else (0, 0)
        sizes = {'D': n_inputs, 'H': n_hidden, '3': 3}
        check_arrays(self, {name: tuple(sizes[letter] for letter in letters)
                            for name, letters in _SHAPES.items()}, ModelError)

    def positions(self, received: np.ndarray) -> np.ndarray:
        """Map received signals, complex128 [N, N_B, N_SB F], to positions, float64 [N, 3] [m]."""
        inputs = (INPUTS[self.inputs](received) - self.input_mean) / self.input_scale
        hidden = np.maximum(inputs @ self.w_in + self.b_in, 0.0)
        return hidden @ self.w_out + self.b_out + self.center

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` file, or raise `OSError` and keep an existing file."""
        write_archive(path, {key: getattr(self, name) for name, key in _KEYS.items()},
                      {'format': _FORMAT, 'inputs': self.inputs, **self.about})

    @classmethod
    @read_once
    def load(cls, path: str | Path) -> 'Network':
        """Read a model from a file, or raise `ModelError`."""
        with translated(ArchiveError, ModelError):
            arrays, about = read_archive(path, 'model', _FORMAT, set(_KEYS.values()))
        inputs = str(about.pop('inputs', 'parts'))
        with translated(ValueError, ModelError, path):
            fields: dict[str, Any] = {
                name: numbers(key, arrays[key], finite=False) for name, key in _KEYS.items()}
            return cls(**fields, about=about, inputs=inputs)


def read_model(file: str | Path) -> Network:
    """Read a model from a file; raise `ModelError` if there is none or it is invalid."""
    if file == '':
        raise ModelError("model_file: '', expected a trained model of the codebook, from "
                         'python3 -m rhs_isac_ros.positioning')
    with translated(ModelError, ModelError, 'model_file'):
        return Network.load(file)


class NeuralEstimator:
    """Positions from a trained network, all with the covariance of the validation residuals.

    The estimator does not test whether signals fit the position. It rejects only signals that are
    weaker than multipath and noise alone, or stronger than any position could explain. Raises
    ModelError if the model is missing, cannot be read, or was trained for another codebook,
    scenario or surface.
    """

    name, uses_surface = 'neural', False
    readers = {'model_file': read_model}

    def __init__(
            self, system: System, model_file: Network | str | Path = '') -> None:
        self.system = system
        system.prepare()
        if system.surface is not None:
            raise ModelError('surface: known or calibrated, expected none, because the network is '
                             'trained for the surface of the scenario')
        self._network = (
            model_file if isinstance(model_file, Network) else read_model(model_file))
        source = 'model' if isinstance(model_file, Network) else str(model_file)
        _check_purpose(self._network, system, source)
        self._test = FitTest(
            int(np.prod(system.shape)), board=system.scenario.board.declared)

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals; see `Estimator.estimate`."""
        return estimate_each(self.system.codebook, received, self._locate)

    def _locate(self, batch: np.ndarray) -> Iterator[Estimate]:
        energies = np.sum(np.abs(self.system.whiten(batch))**2, axis=(1, 2))
        positions = self._network.positions(batch)
        max_mean_energy = float(self._network.max_energy)
        for energy, position in zip(energies.tolist(), positions, strict=True):
            reason = self._test.min_energy_test(energy) or self._test.max_energy_test(
                energy, max_mean_energy)
            yield Estimate(position, self._network.covariance, reason)


def _check_purpose(network: Network, system: System, source: str) -> None:
    scenario = system.scenario.unplaced.changes()
    for key, subject, expected in (('codebook', 'codebook', system.codebook.id),
                                   ('scenario', 'the scenario', scenario)):
        found = network.about.get(key)
        if found != expected:
            raise ModelError(f'{source}: trained for {subject} {found}, expected {expected}')
    n_inputs = (2 if network.inputs == 'parts' else 1) * math.prod(system.shape)
    if len(network.w_in) != n_inputs:
        raise ModelError(f'{source}: {len(network.w_in)} inputs, expected {n_inputs}')


# One thread: more threads change the rounding and do not speed up such small products.
@one_blas_thread
def train(
        scenario: Scenario, codebook: Codebook, n_pairs: int = DEFAULT_PAIRS, seed: int = 0,
        n_hidden: int = DEFAULT_HIDDEN, max_epochs: int = DEFAULT_EPOCHS,
        progress: Callable[[int, float], None] | None = None, inputs: str = 'parts') -> Network:
    """Train a network, and return the state with the smallest validation error.

    The seed determines the pairs, their order and the initial weights. `n_pairs` is at least 20,
    `n_hidden` is the number of hidden units, and `inputs` is a key of `INPUTS`. `progress` is
    called with the number of each epoch and its validation error [m^2]. Raises CodebookError if
    the codebook does not fit the scenario, ValueError if a number is too small, or the inputs or
    the gain are unknown, and MissingLibraryError if scikit-learn is not installed.
    """
    n_pairs, n_hidden = whole('n_pairs', n_pairs, 20), whole('n_hidden', n_hidden, 1)
    max_epochs, seed = whole('max_epochs', max_epochs, 1), whole('seed', seed)
    if inputs not in INPUTS:
        raise ValueError(f'inputs: {inputs!r}, expected one of {sorted(INPUTS)}')
    if scenario.user_gain_std_db == np.inf:
        raise ValueError(
            'user_gain_std_db: unknown, expected a standard deviation: an unknown gain has no '
            'distribution from which to draw examples')
    regressor = _regressor(n_hidden, seed)
    system = System(scenario, codebook)
    positions, received = system.pairs(n_pairs, seed)
    first, second = (n_pairs * percent // 100 for percent in (_VALIDATION_PERCENT, _TEST_PERCENT))
    training, validation, test = slice(first), slice(first, second), slice(second, None)
    features, center = INPUTS[inputs](received), scenario.roi_bounds_m.mean(axis=0)
    mean, scale = features[training].mean(axis=0), features[training].std(axis=0)
    # One unit for all coordinates, so that the loss is the squared error.
    unit_m = np.sqrt(np.mean((positions[training] - center)**2))
    scaled = ((features - mean) / scale).astype(np.float32)
    targets = ((positions - center) / unit_m).astype(np.float32)

    def residuals(subset: slice) -> np.ndarray:
        errors: np.ndarray = regressor.predict(scaled[subset]) - targets[subset]
        return errors.astype(float) * unit_m

    def after_epoch(number: int) -> float:
        mse = _mean_square(residuals(validation))
        if progress:
            progress(number, mse)
        return mse

    best_epoch, best_mse = _fit(
        regressor, scaled[training], targets[training], max_epochs, after_epoch)
    errors = residuals(validation)
    energies = np.sum(np.abs(system.whiten(system.mean(positions)))**2, axis=(1, 2))
    (w_in, w_out), (b_in, b_out) = (
        [array.astype(float) for array in arrays]
        for arrays in (regressor.coefs_, regressor.intercepts_))
    return Network(
        input_mean=mean, input_scale=scale, w_in=w_in, b_in=b_in, w_out=w_out * unit_m,
        b_out=b_out * unit_m, center=center, inputs=inputs,
        covariance=errors.T @ errors / len(errors),
        max_energy=float(energies.max()), about={
            'codebook': codebook.id, 'scenario': scenario.unplaced.changes(), 'seed': seed,
            'pairs': n_pairs, 'epochs': best_epoch, 'version': __version__,
            'validation_mse_m2': best_mse, 'test_mse_m2': _mean_square(residuals(test))})


def _fit(
        regressor: Any, inputs: np.ndarray, targets: np.ndarray, max_epochs: int,
        after_epoch: Callable[[int], float]) -> tuple[int, float]:
    """Train for at most `max_epochs`; restore the best weights, return their epoch and error."""
    best_weights: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    best_mse, best_epoch, reference_epoch = np.inf, 0, 0
    sizes = [min(size, len(inputs)) for size in _BATCH_SIZES]
    regressor.set_params(batch_size=sizes.pop(0))
    for number in range(1, max_epochs + 1):
        regressor.partial_fit(inputs, targets)
        mse = after_epoch(number)
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
    with optional_import('training', extra='neural'):
        from sklearn.neural_network import MLPRegressor
    state = int(streams.generator(seed, streams.TRAINING).integers(2**32))
    return MLPRegressor(
        hidden_layer_sizes=(n_hidden,), activation='relu', solver='adam', alpha=0.0,
        learning_rate_init=_LEARNING_RATE, random_state=state)


def _mean_square(errors: np.ndarray) -> float:
    return float(np.mean(np.sum(errors**2, axis=1)))
