"""Estimators of the user's position from the received signals."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, plugins
from rhs_isac_ros.positioning.bayes import BayesEstimator
from rhs_isac_ros.positioning.estimate import Estimate, Estimator, SignalError
from rhs_isac_ros.positioning.exhaustive import exhaustive_posterior
from rhs_isac_ros.positioning.ml import MlEstimator
from rhs_isac_ros.positioning.network import ModelError, Network
from rhs_isac_ros.positioning.neural import NeuralEstimator
from rhs_isac_ros.positioning.simulate import simulate_pairs
from rhs_isac_ros.positioning.training import train

ESTIMATORS: Mapping[str, type] = {
    kind.name: kind for kind in (BayesEstimator, MlEstimator, NeuralEstimator)}

__all__ = [
    'ESTIMATORS', 'BayesEstimator', 'Estimate', 'Estimator', 'MlEstimator', 'ModelError',
    'Network', 'NeuralEstimator', 'SignalError', 'exhaustive_posterior', 'file_options',
    'make_estimator', 'simulate_pairs', 'train',
]


def make_estimator(
        name: str, scenario: Scenario, codebook: Codebook, **options: Any) -> Estimator:
    """Make an estimator by its name.

    Parameters
    ----------
    name
        One of `ESTIMATORS`, or a plug-in: an entry point of the group `plugins.ESTIMATORS`.
    scenario
        The scenario.
    codebook
        The codebook with which the signals are taken.
    **options
        Options of that estimator: ``table_folder`` of `bayes` and `ml`, where tables are kept;
        ``model_file`` of `neural`, what `train` returns or its file. A plug-in has its own.

    Returns
    -------
    Estimator
        The estimator, with its tables built.

    Raises
    ------
    ValueError
        If there is no estimator of that name.
    PluginError
        If a plug-in cannot be loaded, fails, or makes no estimator.
    ModelError
        If a model cannot be read or is one of another codebook or scenario.
    CodebookError
        If the codebook does not fit the scenario.
    """
    if name in ESTIMATORS:
        return ESTIMATORS[name](scenario, codebook, **options)
    there = plugins.names(plugins.ESTIMATORS)
    if name not in there:
        raise ValueError(f'estimator: {name!r}, expected one of {sorted({*ESTIMATORS, *there})}')
    estimator = plugins.make(plugins.ESTIMATORS, name, scenario, codebook, **options)
    if not (callable(getattr(estimator, 'estimate', None))
            and isinstance(getattr(estimator, 'name', None), str)):
        raise plugins.PluginError(
            f'{plugins.describe(plugins.ESTIMATORS, name)}: made {estimator!r}, expected an '
            'estimator, with a method estimate and a string name')
    return estimator


def file_options(name: str, table_folder: Path, model_file: str | Path) -> dict[str, Any]:
    """Choose the options of an estimator from the files that there are.

    Parameters
    ----------
    name
        Name of the estimator.
    table_folder
        Where tables are kept.
    model_file
        Trained model; empty if there is none.

    Returns
    -------
    dict
        Options for `make_estimator`: a plug-in gets the model if there is one, and nothing else.
    """
    if name == NeuralEstimator.name or (name not in ESTIMATORS and model_file):
        return {'model_file': model_file}
    return {'table_folder': table_folder} if name in ESTIMATORS else {}
