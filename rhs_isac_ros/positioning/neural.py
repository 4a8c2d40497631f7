"""The paper's estimator: a network with one hidden layer, trained on simulated pairs."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.positioning.fit import FitTest
from rhs_isac_ros.positioning.network import ModelError, Network
from rhs_isac_ros.positioning.whitened import WhitenedModel


class NeuralEstimator:
    """Positions by a trained network.

    The covariance is the same for all: the mean product of the residuals that the validation
    pairs had. The network cannot tell whether signals fit its answer. Those weaker than noise or
    stronger than from any position give no fix, others always a position.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.
    model_file
        A model that was trained for both, or its file.

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
        self._model = WhitenedModel(scenario, codebook)
        if isinstance(model_file, str) and not model_file:
            raise ModelError(
                'model_file: none, expected a model of this codebook, which '
                'python -m rhs_isac_ros.positioning trains')
        known = isinstance(model_file, Network)
        self._network = model_file if known else Network.load(model_file)
        where = 'model' if known else str(model_file)
        check_purpose(self._network, scenario, codebook, where)
        self._test = FitTest(int(np.prod(self._model.shape)))

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals.

        Parameters
        ----------
        received
            Complex128 [N_B, N_SB F], or [N, N_B, N_SB F] for N positions; sub-band-major.

        Returns
        -------
        Estimate
            With a leading N if the signals have one; without a position where they tell none.

        Raises
        ------
        SignalError
            If the shape is another one or a value is not finite.
        """
        model = self._model
        return estimate_each(model.scenario, model.codebook, received, self._locate)

    def _locate(self, batch: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
        energies = np.sum(np.abs(self._model.whiten(batch))**2, axis=(1, 2))
        positions = self._network.positions(batch)
        for energy, position in zip(energies.tolist(), positions, strict=True):
            reason = self._test.silence(energy) or self._test.loudness(
                energy, float(self._network.loudest))
            yield position, self._network.covariance, reason


def check_purpose(
        network: Network, scenario: Scenario, codebook: Codebook, where: str) -> None:
    """Refuse a model that was trained for anything else.

    Parameters
    ----------
    network
        The model.
    scenario
        The scenario.
    codebook
        The codebook.
    where
        Name of the model in the error.

    Raises
    ------
    ModelError
        If codebook, scenario or sizes are others.
    """
    about = network.about
    if about.get('codebook') != codebook.id:
        raise ModelError(f'{where}: trained for codebook {about.get("codebook")}, expected '
                         f'{codebook.id}')
    if about.get('scenario') != scenario.changes():
        raise ModelError(f'{where}: trained for the scenario {about.get("scenario")}, expected '
                         f'{scenario.changes()}')
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    expected = 2 * n_bands * n_subbands * n_frames
    if len(network.w_in) != expected:
        raise ModelError(f'{where}: {len(network.w_in)} inputs, expected {expected}')
