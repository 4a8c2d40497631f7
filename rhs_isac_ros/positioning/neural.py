"""The paper's estimator: a network with one hidden layer, trained on simulated pairs."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.positioning.fit import FitTest
from rhs_isac_ros.positioning.network import ModelError, Network
from rhs_isac_ros.support.threads import one_blas_thread


class NeuralEstimator:
    """Positions by a trained network.

    The covariance is the same for all positions: the second-moment matrix of the residuals of the
    validation pairs. The network cannot test whether signals fit its position. Signals that are
    weaker than noise, or stronger than those from any position, give no position; all others give
    one.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    ModelError
        If the model cannot be read or was trained for another codebook or scenario.
    """

    name = 'neural'

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            model_file: Network | str | Path = '') -> None:
        codebook.check(scenario)
        self._scenario, self._codebook = scenario, codebook
        self._model = MeasurementModel(scenario, codebook).prepare()
        if model_file == '':
            raise ModelError(
                'model_file: none, expected a model of this codebook, trained with '
                'python -m rhs_isac_ros.positioning')
        if isinstance(model_file, Network):
            self._network, source = model_file, 'model'
        else:
            self._network, source = Network.load(model_file), str(model_file)
        check_trained_for(self._network, scenario, codebook, source)
        self._test = FitTest(int(np.prod(self._model.shape)))

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals, as `Estimator.estimate` describes."""
        return estimate_each(self._scenario, self._codebook, received, self._locate)

    def _locate(self, batch: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
        energies = np.sum(np.abs(self._model.whiten(batch))**2, axis=(1, 2))
        positions = self._network.positions(batch)
        max_mean_energy = float(self._network.max_energy)
        for energy, position in zip(energies.tolist(), positions, strict=True):
            reason = self._test.min_energy_test(energy) or self._test.max_energy_test(
                energy, max_mean_energy)
            yield position, self._network.covariance, reason


def check_trained_for(
        network: Network, scenario: Scenario, codebook: Codebook, source: str) -> None:
    """Raise `ModelError` unless a model was trained for a scenario and codebook.

    `source` is the model's name in the error.
    """
    about = network.about
    if about.get('codebook') != codebook.id:
        raise ModelError(f'{source}: trained for codebook {about.get("codebook")}, expected '
                         f'{codebook.id}')
    if about.get('scenario') != scenario.changes():
        raise ModelError(f'{source}: trained for the scenario {about.get("scenario")}, expected '
                         f'{scenario.changes()}')
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    expected = (2 if network.inputs == 'parts' else 1) * n_bands * n_subbands * n_frames
    if len(network.w_in) != expected:
        raise ModelError(f'{source}: {len(network.w_in)} inputs, expected {expected}')
