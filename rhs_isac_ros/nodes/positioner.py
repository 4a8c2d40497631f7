"""The executable ``positioner``: estimates the user's position."""

import dataclasses
import functools
import sys
import time
import types
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import plugins
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    Estimator,
    ModelError,
    Network,
    NeuralEstimator,
    file_options,
    make_estimator,
)
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    Action,
    BuildEstimator,
    CodebookOffered,
    EstimatorFailed,
    EstimatorReady,
)
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.settings import PositionerSettings
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.background import Background
from rhs_isac_ros.ros.parameters import ParameterError, settings_of
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class PositionerNode(RoleNode):
    """The positioner; it listens to received signals once its tables are built."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('positioner', Positioner.SENDS, **node_options)
        settings = self.settings(self.values)
        self._background = Background(self)
        self._pose = self.create_publisher(
            PoseWithCovarianceStamped, topics.POSITION, qos.EXCHANGE)
        self.start(Positioner(self.scenario, time.perf_counter, settings), ())
        self.follow_codebook(lambda codebook: self.dispatch(CodebookOffered(codebook)))

    def settings(self, values: types.SimpleNamespace) -> PositionerSettings:
        """Return which estimator to use; whether its model fits a codebook shows later.

        Parameters
        ----------
        values
            The parameters, by name.

        Returns
        -------
        PositionerSettings
            The settings.

        Raises
        ------
        ParameterError
            If the estimator needs a model and there is none, or it cannot be read.
        """
        settings = settings_of(PositionerSettings, values)
        if settings.estimator not in ESTIMATORS:
            self._check_plugin(settings.estimator)
            return settings
        if settings.estimator != NeuralEstimator.name:
            # The file is kept as a parameter, and changes nothing.
            return dataclasses.replace(settings, model_file='')
        if not settings.model_file:
            raise ParameterError(
                "model_file: '', expected a trained model for the estimator neural")
        try:
            Network.load(settings.model_file)
        except ModelError as error:
            raise ParameterError(f'model_file: {error}') from None
        return settings

    @staticmethod
    def _check_plugin(name: str) -> None:
        """Refuse a plug-in without its code; whether it works shows later."""
        try:
            plugins.load(plugins.ESTIMATORS, name)
        except plugins.PluginError as error:
            raise ParameterError(f'estimator: {error}') from None

    def _make(self, settings: PositionerSettings, codebook: Codebook) -> Estimator:
        folder = self.values.table_folder
        options = file_options(
            settings.estimator, Path(folder) if folder else default_folder(),
            settings.model_file)
        return make_estimator(settings.estimator, self.scenario, codebook, **options)

    def perform(self, action: Action) -> None:
        """Make an estimator, in the background.

        Parameters
        ----------
        action
            What the role asks for.

        Raises
        ------
        TypeError
            If it asks for anything else.
        """
        if not isinstance(action, BuildEstimator):
            super().perform(action)
        self._background.run(
            functools.partial(
                build_estimator, action.codebook,
                functools.partial(self._make, action.settings), time.perf_counter),
            self._on_estimator)

    def _on_estimator(self, event: EstimatorReady | EstimatorFailed) -> None:
        self.dispatch(event)
        if isinstance(event, EstimatorReady):
            self.listen(Positioner.RECEIVES)

    def publish(self, message: m.Message) -> bool:
        """Publish an estimate, and the same as a standard pose.

        Parameters
        ----------
        message
            The estimate, or that there is none.

        Returns
        -------
        bool
            Whether it was published.
        """
        sent = super().publish(message)
        if sent and isinstance(message, m.PositionEstimate):
            self._pose.publish(convert.pose(message, self.get_clock().now().to_msg()))
        return sent

    def destroy_node(self) -> None:
        """End the background thread, then the node."""
        self._background.close()
        super().destroy_node()


main = entry(lambda: [PositionerNode()])


if __name__ == '__main__':
    sys.exit(main())
