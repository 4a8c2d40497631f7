"""Estimators of the user's position from the received signals.

`make_estimator` creates an estimator for a scenario and a codebook: an object with the interface
of `Estimator`, whose method ``estimate`` takes received signals and returns an `Estimate`. The
classes of estimators are listed in `ESTIMATORS` below, and other packages may provide more as
entry points of `plugins.ESTIMATORS`. A `Tracker` combines successive positioning phases of a
moving user. A shot is the signals of one positioning phase in a batch of them.

Positions are ranges and direction cosines, (r, u, v), in which the modes of the likelihood are
nearly Gaussian: the signals determine the range to a fraction of a wavelength, but the direction
only to a fraction of a beam. In Cartesian coordinates, the modes are curved.

The modules, in reading order:

* `estimate`: the interface; `estimators`: `bayes` and `ml`, from signals to positions
* `mixture`: Gaussians in the frame of the site; `sheets`: Gaussians in range and direction cosines
  around a surface, also restricted to the region of interest
* `lattice`: lengths over which signals change, and the grid; `segments`: points of each shot
* `likelihood`: the likelihood of positions and nuisance parameters; `nuisance`: the prior of the
  parameters; `dispersed`: errors of elements; `offsets`: carrier and timing from signals alone
* `templates`, `peaks`, `grid`: starts of the search; `moving`: those of users who move in a cycle;
  `projection`: signals of many measurements; `scope`: where `search` ascends from the starts to
  the modes; `failures`: modes if elements have failed
* `posterior`: from modes to samples; `draws`: samples without modes; `alternatives`: users outside
  or blocked; `diagnosis`: tests of the fit between signals and model;
  `movement`: tests of how users move in a cycle
* `prior`: the update of a mixture with signals, and errors that all phases share; `products` of
  sheets, and `fusion`: several surfaces; `beyond`: users outside of a site; `agreement`: surfaces
  whose pose is wrong; `alignment`: the pose of a surface from common users; `site`: the surfaces
  of a site in a file
* `tracking`: moving users
* `neural`: the paper's network; `store`: tables in files
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import KnownSurface
from rhs_isac_ros.positioning.estimate import (
    Estimate,
    Estimator,
    Sighting,
    SignalError,
    estimate_each,
)
from rhs_isac_ros.positioning.estimators import (
    BayesEstimator,
    MlEstimator,
    SearchEstimator,
)
from rhs_isac_ros.positioning.fusion import fuse
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.neural import ModelError, Network, NeuralEstimator, train
from rhs_isac_ros.positioning.site import Site, SiteError, SiteEstimator
from rhs_isac_ros.positioning.tracking import Motion, Tracker
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.arguments import parse_options
from rhs_isac_ros.system import System

ESTIMATORS: Mapping[str, Callable[..., Estimator]] = {
    kind.name: kind for kind in (BayesEstimator, MlEstimator, NeuralEstimator)}

__all__ = [
    'ESTIMATORS', 'BayesEstimator', 'Estimate', 'Estimator', 'EstimatorKind', 'Mixture',
    'MlEstimator', 'ModelError', 'Motion', 'Network', 'NeuralEstimator', 'SearchEstimator',
    'Sighting', 'SignalError', 'Site', 'SiteError', 'SiteEstimator', 'Tracker', 'estimate_each',
    'fuse', 'make_estimator', 'train',
]


def make_estimator(name: Any, scenario: Scenario, codebook: Codebook, *,
                   surface: KnownSurface | None = None, **options: Any) -> Estimator:
    """Create an estimator of a system; see `EstimatorKind.create`.

    `surface` is that of the system, such as a calibration; None stands for that of the scenario.
    `name` is that of a built-in estimator or of an installed plug-in, ``module:name``, or the
    class or callable itself. `bayes` and `ml` take the options of `SearchEstimator`. `neural`
    requires ``model_file``, a `Network` or its file. Plug-ins define their own options.

    Raises ValueError if there is no estimator of that name; PluginError if a plug-in cannot be
    loaded, fails, or does not return an estimator; ModelError if a model is missing, cannot be
    read, or was trained for another codebook or scenario; and CodebookError if the codebook does
    not fit the scenario.

    Examples
    --------
    >>> scenario, codebook, user = Scenario(), Codebook.default(), np.array([8.0, 1.0, 0.2])
    >>> received = simulate_received(scenario, codebook, user[None], np.random.default_rng(1))
    >>> fix = make_estimator('bayes', scenario, codebook).estimate(received[0])
    >>> bool(np.linalg.norm(fix.mean - user) < 2 * np.sqrt(np.trace(fix.covariance)))
    True
    """
    return EstimatorKind(name).create(System(scenario, codebook, surface), **options)


class EstimatorKind:
    """The estimators of one name, with what their class or plug-in declares.

    A class or callable may take the place of its name. The options are the parameters of the
    constructor. A class declares with ``uses_tracks`` that a track may be the prior, as in
    `BayesEstimator`; with ``uses_surface = False`` that it assumes the surface of the scenario;
    and with ``readers`` the options that are required files, each with the function that reads it.
    Raises ValueError if there is no estimator of that name, and PluginError if a plug-in cannot be
    loaded.
    """

    def __init__(self, name: Any) -> None:
        self.name = plugins.name_of(name)
        self._is_plugin = self.name not in ESTIMATORS
        if self._is_plugin and not plugins.is_reference(self.name) and (
                self.name not in (installed := plugins.names(plugins.ESTIMATORS))):
            raise ValueError(
                f'estimator: {name!r}, expected one of {sorted({*ESTIMATORS, *installed})}')
        made: Any = (plugins.load(plugins.ESTIMATORS, self.name) if self._is_plugin
                     else ESTIMATORS[self.name])
        if not callable(made):
            raise plugins.PluginError(f'{self.name}: {made!r}, expected a class or a callable')
        parameters = inspect.signature(made).parameters
        #: Names of the options; a plug-in with ``**options`` takes any others as well.
        self.options = {*parameters} - {'system', 'scenario', 'codebook'}
        self.takes_any = any(one.kind is one.VAR_KEYWORD for one in parameters.values())
        if self.takes_any:
            self.options |= {'model_file', 'surface'}
        # A plug-in takes a system, or a scenario, a codebook and perhaps a surface.
        self._takes_system = 'system' in parameters
        self.uses_tracks: bool = getattr(made, 'uses_tracks', False)
        self.uses_surface: bool = getattr(
            made, 'uses_surface', self._takes_system or 'surface' in self.options)
        self.readers: Mapping[str, Callable[[str], Any]] = getattr(made, 'readers', {})

    def accepted(self, **offered: Any) -> dict[str, Any]:
        """Return those of the offered options that the estimator takes, without empty texts."""
        return {name: value for name, value in offered.items()
                if name in self.options and value != ''}

    def parse(self, text: str) -> dict[str, Any]:
        """Return the options in a text such as ``log2_points=12``; see `parse_options`.

        Raises ValueError if the estimator does not take one of them.
        """
        options = parse_options(text)
        for name in options:
            if not (self.takes_any or name in self.options):
                raise ValueError(f'{name!r}, expected an option of {self.name}: '
                                 f'{", ".join(sorted(self.options))}')
        return options

    def create(self, system: System, **options: Any) -> Estimator:
        """Create an estimator for a system; see `make_estimator` for options and errors."""
        if not self._is_plugin:
            return ESTIMATORS[self.name](system, **options)
        parts: tuple[Any, ...] = (system,)
        if not self._takes_system:
            parts = system.scenario, system.codebook
            options |= {} if system.surface is None else {'surface': system.surface}
        estimator: Estimator = plugins.make(
            plugins.ESTIMATORS, self.name, Estimator, *parts, **options)
        if not isinstance(estimator.name, str):
            raise plugins.PluginError(f'{self.name}: name {estimator.name!r}, expected a string')
        return estimator
