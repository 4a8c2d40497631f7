"""The paper's network: one hidden layer from received signals to a position, and its file."""

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.model.files import write_whole

_FORMAT = 1


class ModelError(ValueError):
    """A trained model cannot be read, or is one of another codebook or scenario."""


@dataclasses.dataclass(frozen=True, eq=False)
class Network:
    """A trained network, and what it was trained for.

    Its input x are real and imaginary parts of the received signals, [D] = [2 N_B N_SB F], each
    brought to zero mean and unit variance; the position is
    p = center + w_out^T max(0, w_in^T x + b_in) + b_out, in metres.

    Attributes
    ----------
    input_mean, input_scale
        Mean and standard deviation of the parts in training, float64 [D].
    w_in, b_in
        Weights of the hidden layer, float64 [D, H] and [H].
    w_out, b_out
        Weights of the output, float64 [H, 3] and [3] [m].
    center
        Centre of the region of interest, float64 [3] [m].
    covariance
        Mean product of the residuals of the validation pairs, float64 [3, 3] [m^2].
    loudest
        Largest square norm of the whitened mean signal of a training position.
    about
        ``codebook``, its id; ``scenario``, its changes from Table I; ``seed``, ``pairs``,
        ``epochs``, ``version``; ``validation_mse_m2`` and ``test_mse_m2``.
    """

    input_mean: np.ndarray
    input_scale: np.ndarray
    w_in: np.ndarray
    b_in: np.ndarray
    w_out: np.ndarray
    b_out: np.ndarray
    center: np.ndarray
    covariance: np.ndarray
    loudest: float
    about: dict[str, Any]

    def __post_init__(self) -> None:
        """Check that sizes agree and numbers are finite."""
        n_parts, n_hidden = np.shape(self.w_in) if np.ndim(self.w_in) == 2 else (0, 0)
        shapes = {'input_mean': (n_parts,), 'input_scale': (n_parts,), 'w_in': (n_parts, n_hidden),
                  'b_in': (n_hidden,), 'w_out': (n_hidden, 3), 'b_out': (3,), 'center': (3,),
                  'covariance': (3, 3), 'loudest': ()}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if np.shape(value) != shape:
                raise ModelError(f'{name}: shape {np.shape(value)}, expected {shape}')
            if not np.isfinite(value).all():
                raise ModelError(f'{name}: not finite, expected finite numbers')

    def positions(self, received: np.ndarray) -> np.ndarray:
        """Map received signals to positions.

        Parameters
        ----------
        received
            Complex128 [N, N_B, N_SB F].

        Returns
        -------
        numpy.ndarray
            Float64 [N, 3] [m].
        """
        parts = (real_parts(received) - self.input_mean) / self.input_scale
        hidden = np.maximum(parts @ self.w_in + self.b_in, 0.0)
        return hidden @ self.w_out + self.b_out + self.center

    def save(self, path: str | Path) -> None:
        """Write the model; an old file is replaced at the end.

        Parameters
        ----------
        path
            The file, of NumPy's format ``.npz`` without pickled objects.

        Raises
        ------
        OSError
            If the file cannot be written; the old one is kept.
        """
        arrays = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        arrays['about'] = json.dumps({'format': _FORMAT, **self.about})
        write_whole(path, lambda stream: np.savez(stream, **arrays))

    @classmethod
    def load(cls, path: str | Path) -> 'Network':
        """Read a model.

        Parameters
        ----------
        path
            The file.

        Returns
        -------
        Network
            The model of the file.

        Raises
        ------
        ModelError
            If the file cannot be read, is damaged, or holds no model.
        """
        try:
            with open(path, 'rb') as stream:
                file = np.load(stream, allow_pickle=False)
                arrays = {name: file[name] for name in getattr(file, 'files', ())}
            about = json.loads(str(arrays.pop('about', '{}')))
        # Reading checks the sums that the format keeps of every array.
        except (OSError, ValueError, EOFError, NotImplementedError, SyntaxError, KeyError,
                zipfile.BadZipFile) as error:
            reason = ' '.join(str(error).split())
            raise ModelError(f'{path}: cannot be read: {reason}') from error
        names = {field.name for field in dataclasses.fields(cls)} - {'about'}
        if not isinstance(about, dict) or about.pop('format', 0) != _FORMAT or (
                arrays.keys() != names):
            raise ModelError(f'{path}: no model, expected one of format {_FORMAT}')
        try:
            return cls(**{name: array.astype(float) for name, array in arrays.items()},
                       about=about)
        except ValueError as error:
            raise ModelError(f'{path}: {error}') from None


def real_parts(received: np.ndarray) -> np.ndarray:
    """Real and imaginary parts of received signals.

    Parameters
    ----------
    received
        Complex128 [N, N_B, N_SB F].

    Returns
    -------
    numpy.ndarray
        Float64 [N, D]: all real parts, then all imaginary parts.
    """
    flat = received.reshape(len(received), -1)
    return np.hstack([flat.real, flat.imag])
