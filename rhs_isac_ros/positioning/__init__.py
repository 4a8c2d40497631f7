"""Estimators of the user's position from the received signals.

`make_estimator` creates an estimator for a scenario and a codebook: an object with the interface
of `Estimator`, whose method ``estimate`` takes received signals and returns an `Estimate`. The
classes of estimators are listed in `ESTIMATORS` below, and other packages may provide more as
entry points of `plugins.ESTIMATORS`. A `Tracker` combines successive positioning phases of a
moving user. A shot is the signals of one positioning
phase in a batch of them.

Positions are ranges and direction cosines, (r, u, v), in which the modes of the likelihood are
nearly Gaussian: the signals determine the range to a fraction of a wavelength, but the direction
only to a fraction of a beam. In Cartesian coordinates, the modes are curved.

The modules, in reading order:

* `estimate`: the interface; `estimators`: `bayes` and `ml`, from signals to positions
* `lattice`: lengths over which signals change, and the grid; `segments`: points of each shot
* `region`: Gaussians restricted to the region of interest
* `likelihood`: the likelihood of positions and nuisance parameters
* `templates`, `peaks`, `grid`: starts of the search; `search`: ascent from the starts to the
  modes; `failures`: modes if elements have failed
* `posterior`: from modes to samples; `draws`: samples without modes; `alternatives`: users outside
  or blocked; `diagnosis`: tests of the fit between signals and model
* `mixture`: posteriors in the frame of the site; `prior`: their update with signals; `fusion`:
  several surfaces; `agreement`: surfaces whose pose is wrong; `alignment`: the pose of a surface
  from common users; `site`: the surfaces of a site in a file
* `tracking`: moving users; `neural`: the paper's network; `store`: tables in files
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, Estimator, SignalError, estimate_each
from rhs_isac_ros.positioning.estimators import (
    BayesEstimator,
    MlEstimator,
    SearchEstimator,
    WeightedModes,
    weighted_modes,
)
from rhs_isac_ros.positioning.fusion import Fused, Sighting, fuse
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.neural import ModelError, Network, NeuralEstimator, train
from rhs_isac_ros.positioning.site import Site, SiteError, SiteEstimator
from rhs_isac_ros.positioning.tracking import Motion, Tracker, TrackEstimate
from rhs_isac_ros.support import plugins

ESTIMATORS: Mapping[str, Callable[..., Estimator]] = {
    kind.name: kind for kind in (BayesEstimator, MlEstimator, NeuralEstimator)}
# Estimators with the option ``reject_outside``.
REGION_ESTIMATORS = (BayesEstimator.name, MlEstimator.name)

__all__ = [
    'ESTIMATORS', 'REGION_ESTIMATORS', 'BayesEstimator', 'Estimate', 'Estimator', 'Fused',
    'Mixture', 'MlEstimator', 'ModelError', 'Motion', 'Network', 'NeuralEstimator',
    'SearchEstimator', 'Sighting', 'SignalError', 'Site', 'SiteError', 'SiteEstimator',
    'TrackEstimate', 'Tracker', 'WeightedModes', 'estimate_each', 'file_options',
    'fuse', 'make_estimator', 'train', 'weighted_modes',
]


def make_estimator(
        name: str, scenario: Scenario, codebook: Codebook, **options: Any) -> Estimator:
    """Create an estimator by its name.

    `REGION_ESTIMATORS` take the options of `SearchEstimator`. `neural` requires ``model_file``, a
    `Network` or its file. Plug-ins define their own options.

    Raises ValueError if there is no estimator of that name; PluginError if a plug-in cannot be
    loaded, fails, or does not return an estimator; ModelError if a model is missing, cannot be
    read, or was trained for another codebook or scenario; and CodebookError if the codebook does
    not fit the scenario.
    """
    if name in ESTIMATORS:
        return ESTIMATORS[name](scenario, codebook, **options)
    installed = plugins.names(plugins.ESTIMATORS)
    if name not in installed:
        raise ValueError(
            f'estimator: {name!r}, expected one of {sorted({*ESTIMATORS, *installed})}')
    estimator: Estimator = plugins.make(plugins.ESTIMATORS, name, scenario, codebook, **options)
    if not (callable(getattr(estimator, 'estimate', None))
            and isinstance(getattr(estimator, 'name', None), str)):
        raise plugins.PluginError(
            f'{plugins.describe(plugins.ESTIMATORS, name)}: returned {estimator!r}, expected '
            'an object with a method estimate and a string name')
    return estimator


def file_options(
        name: str, table_folder: Path | None, model_file: str | Path) -> dict[str, Any]:
    """Return the options of `make_estimator` that specify the files of an estimator.

    The estimators `bayes` and `ml` take the table folder; without one, they keep tables only in
    memory. The model file goes to `neural` and,
    unless it is empty, to plug-ins.
    """
    if name == NeuralEstimator.name or (name not in ESTIMATORS and model_file):
        return {'model_file': model_file}
    return {'table_folder': table_folder} if name in ESTIMATORS else {}
