"""The paper's network, with one hidden layer from received signals to a position, and its file."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.positioning.estimate import stack_parts
from rhs_isac_ros.support.files import ArchiveError, read_archive, write_archive

_FORMAT = 1
# Keys of the file that differ from the names of the fields.
_FILE_KEYS = {'max_energy': 'loudest'}


def magnitudes(signals: np.ndarray) -> np.ndarray:
    """Flatten complex signals [N, N_B, N_SB F] to their magnitudes, float64 [N, N_B N_SB F]."""
    return np.abs(signals.reshape(len(signals), -1))


# Inputs of a network as functions of the received signals. The paper does not specify them.
INPUTS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    'parts': stack_parts, 'magnitudes': magnitudes}


class ModelError(ValueError):
    """A trained model cannot be read, or belongs to another codebook or scenario."""


@dataclasses.dataclass(frozen=True, eq=False)
class Network:
    """A trained network, with the arguments and results of its training.

    The input x consists of the real and imaginary parts of the received signals, [D] =
    [2 N_B N_SB F], or of their magnitudes, [D] = [N_B N_SB F], each scaled to zero mean and unit
    variance. The position is p = center + w_out^T max(0, w_in^T x + b_in) + b_out, in metres.

    Attributes
    ----------
    input_mean, input_scale
        Mean and standard deviation of the inputs in training, float64 [D].
    w_in, b_in
        Weights of the hidden layer, float64 [D, H] and [H].
    w_out, b_out
        Weights of the output, float64 [H, 3] and [3] [m].
    center
        Centre of the region of interest, float64 [3] [m].
    covariance
        Second-moment matrix of the residuals of the validation pairs, float64 [3, 3] [m^2].
    max_energy
        Largest squared norm of the whitened mean signal at a training position.
    about
        ``codebook``, the id of the codebook; ``scenario``, the fields that differ from Table I;
        ``seed``, ``pairs``, ``epochs``, ``version``; ``validation_mse_m2`` and ``test_mse_m2``.
    inputs
        One of `INPUTS`: ``parts`` or ``magnitudes``.
    """

    input_mean: np.ndarray
    input_scale: np.ndarray
    w_in: np.ndarray
    b_in: np.ndarray
    w_out: np.ndarray
    b_out: np.ndarray
    center: np.ndarray
    covariance: np.ndarray
    max_energy: float
    about: dict[str, Any]
    inputs: str = 'parts'

    def __post_init__(self) -> None:
        """Check that sizes agree and numbers are finite."""
        if self.inputs not in INPUTS:
            raise ModelError(f'inputs: {self.inputs!r}, expected one of {sorted(INPUTS)}')
        n_inputs, n_hidden = np.shape(self.w_in) if np.ndim(self.w_in) == 2 else (0, 0)
        shapes: dict[str, tuple[int, ...]] = {
            'input_mean': (n_inputs,), 'input_scale': (n_inputs,), 'w_in': (n_inputs, n_hidden),
            'b_in': (n_hidden,), 'w_out': (n_hidden, 3), 'b_out': (3,), 'center': (3,),
            'covariance': (3, 3), 'max_energy': ()}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if np.shape(value) != shape:
                raise ModelError(f'{name}: shape {np.shape(value)}, expected {shape}')
            if not np.isfinite(value).all():
                raise ModelError(f'{name}: not finite, expected finite numbers')

    def positions(self, received: np.ndarray) -> np.ndarray:
        """Map received signals, complex128 [N, N_B, N_SB F], to positions, float64 [N, 3] [m]."""
        inputs = (INPUTS[self.inputs](received) - self.input_mean) / self.input_scale
        hidden = np.maximum(inputs @ self.w_in + self.b_in, 0.0)
        return hidden @ self.w_out + self.b_out + self.center

    def save(self, path: str | Path) -> None:
        """Write the model to a file of NumPy's format ``.npz``, without pickled objects.

        An existing file is replaced at the end, or kept if there is an `OSError`.
        """
        write_archive(
            path, {key: getattr(self, name) for key, name in self._names_by_key().items()},
            {'format': _FORMAT, 'inputs': self.inputs, **self.about})

    @classmethod
    def load(cls, path: str | Path) -> 'Network':
        """Read a model from a file.

        Raises
        ------
        ModelError
            If the file cannot be read, is damaged, or does not contain a model.
        """
        names = cls._names_by_key()
        try:
            arrays, about = read_archive(path, 'model', _FORMAT, set(names))
        except ArchiveError as error:
            raise ModelError(str(error)) from error
        inputs = str(about.pop('inputs', 'parts'))
        try:
            fields: dict[str, Any] = {
                names[key]: array.astype(float) for key, array in arrays.items()}
            return cls(**fields, about=about, inputs=inputs)
        except ValueError as error:
            raise ModelError(f'{path}: {error}') from None

    @classmethod
    def _names_by_key(cls) -> dict[str, str]:
        """Map the keys of the arrays in a file to the names of their fields."""
        names = [field.name for field in dataclasses.fields(cls)
                 if field.name not in ('about', 'inputs')]
        return {_FILE_KEYS.get(name, name): name for name in names}
