"""The executable ``positioner``: estimates the positions of users."""

import dataclasses
import functools
import time
import types
from collections.abc import Mapping
from typing import Any

import numpy as np
from rclpy.impl.logging_severity import LoggingSeverity

from rhs_isac_ros import positioning
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import simulate_received
from rhs_isac_ros.model.geometry import movement_warning
from rhs_isac_ros.positioning.alternatives import unrecognised_outside
from rhs_isac_ros.positioning.estimate import estimate_of
from rhs_isac_ros.positioning.site import share_left_out
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.settings import PositionerSettings
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.diagnostics import TABLE_PROGRESS
from rhs_isac_ros.ros.parameters import calibrated_surface
from rhs_isac_ros.ros.poses import LocatingNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError
from rhs_isac_ros.system import System

# Minimum time between log messages about the progress of a table [s].
_LOG_PERIOD_S = 5.0


class PositionerNode(LocatingNode[Positioner]):
    """The positioner, which serves once its first estimator is built."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('positioner', **node_options)
        if text := movement_warning(self.scenario):
            endpoints.log(self, text, LoggingSeverity.WARN)
        settings = self.make_settings(self.values)
        if settings.reject_outside and (text := unrecognised_outside(self.scenario)):
            endpoints.log(self, text)
        self._worker, self._table = endpoints.BackgroundWorker(self), ''
        self.endings.callback(self._worker.close)
        self.start(
            Positioner(self.scenario, time.perf_counter, settings,
                       lambda: self.is_observed(m.Posterior), self.library,
                       share_left_out(self.surface.site)), subscribe=False)

    def make_settings(self, values: types.SimpleNamespace) -> PositionerSettings:
        """Return the settings; raise ParameterError if they, a file or a plug-in cannot be used.

        A model is checked against the codebook only when the estimator is built.
        """
        settings: PositionerSettings = super().make_settings(values)
        surface = calibrated_surface(values, self.surface)
        with translated(plugins.PluginError, ParameterError, 'estimator'):
            # A plug-in that can be imported may still fail when the estimator is built.
            kind = positioning.EstimatorKind(settings.estimator)
        if surface and not kind.uses_surface:
            raise ParameterError(
                f'calibration_file: {settings.calibration_file!r}, expected none for the '
                f'estimator {kind.name}, which assumes the surface of the scenario')
        with translated(ValueError, ParameterError, 'estimator_options'):
            options = {'model_file': settings.model_file, **kind.parse(settings.estimator_options)}
        if 'model_file' not in kind.options:
            # A new `model_file` must not rebuild an estimator that does not use it.
            settings = dataclasses.replace(settings, model_file='')
        for name, read in kind.readers.items():
            with translated(ValueError, ParameterError):
                read(options.get(name, ''))
        return settings

    def _make_estimator(
            self, settings: PositionerSettings, codebook: Codebook) -> positioning.Estimator:
        kind = positioning.EstimatorKind(settings.estimator)
        surface = calibrated_surface(settings, self.surface)
        options = kind.accepted(
            table_folder=self.table_folder, model_file=settings.model_file,
            reject_outside=settings.reject_outside, progress=self._on_progress,
            left_out=share_left_out(self.surface.site))
        estimator = kind.create(System(self.scenario, codebook, surface), **{
            **options, **kind.parse(settings.estimator_options)})
        # The first estimate takes longer than later ones; no user should have to wait for it.
        center = np.array([self.scenario.roi_center_m])
        estimate_of(estimator, simulate_received(
            self.scenario, codebook, center, np.random.default_rng(0))[0])
        for cell in self.library.codebooks[:1]:
            # The same applies to the first estimator without a table, whose imports take a second.
            positioning.BayesEstimator(System(self.scenario, cell), lazy=True)
        return estimator

    def _on_progress(self, share: float) -> None:
        """Log the completed share of a table; called from the background thread."""
        self._table = f'{100 * share:.0f} %' if share < 1 else ''
        self.get_logger().info(  # type: ignore[no-untyped-call]
            f'table of templates: {100 * share:.0f} % computed',
            throttle_duration_sec=_LOG_PERIOD_S, skip_first=True)

    def details(self) -> Mapping[str, str]:
        """Return the progress of a table that is being computed."""
        return {TABLE_PROGRESS: self._table} if self._table else {}

    def execute(self, action: events.Action) -> None:
        """Build or prepare an estimator in the background, or process another action."""
        match action:
            case events.BuildEstimator(codebook, settings):
                make = functools.partial(self._make_estimator, settings)
                self._worker.run(
                    functools.partial(build_estimator, codebook, make, time.perf_counter),
                    self._on_estimator)
            case events.PrepareEstimator(estimator):
                self._worker.run(estimator.prepare, lambda _: None)
            case _:
                super().execute(action)

    def _on_estimator(self, event: events.EstimatorBuilt) -> None:
        self.dispatch(event)
        if event.estimator is not None:
            self.subscribe()


main = entry('positioner', lambda: [PositionerNode()])
