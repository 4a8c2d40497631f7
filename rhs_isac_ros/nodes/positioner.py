"""The executable ``positioner``: estimates the user's position."""

import functools
import sys
import time
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
    CodebookOffered,
    EstimatorFailed,
    EstimatorMade,
    MakeEstimator,
)
from rhs_isac_ros.protocol.positioner import Positioner, make_estimator_for
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.background import Background
from rhs_isac_ros.ros.parameters import ParameterError
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry

SENDS = (m.PositionEstimate, m.NoFix)
RECEIVES = (m.ReceivedSignals,)


class PositionerNode(RoleNode):
    """The positioner; it listens to received signals once its tables are built."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('positioner', SENDS, **node_options)
        name = self.values.estimator
        if name == NeuralEstimator.name:
            self._check_model(self.values.model_file)
        elif name not in ESTIMATORS:
            self._check_plugin(name)
        self._background = Background(self)
        self._pose = self.create_publisher(
            PoseWithCovarianceStamped, topics.POSITION, qos.EXCHANGE)
        self.start(Positioner(self.scenario, time.perf_counter), ())
        self.follow_codebook(lambda codebook: self.tell(CodebookOffered(codebook)))

    @staticmethod
    def _check_model(file: str) -> None:
        """Refuse to start without a model; whether it fits a codebook shows later."""
        if not file:
            raise ParameterError(
                "model_file: '', expected a trained model for the estimator neural")
        try:
            Network.load(file)
        except ModelError as error:
            raise ParameterError(f'model_file: {error}') from None

    @staticmethod
    def _check_plugin(name: str) -> None:
        """Refuse to start without the code; whether it works shows later."""
        try:
            plugins.load(plugins.ESTIMATORS, name)
        except plugins.PluginError as error:
            raise ParameterError(f'estimator: {error}') from None

    def _make(self, codebook: Codebook) -> Estimator:
        values = self.values
        folder = Path(values.table_folder) if values.table_folder else default_folder()
        options = file_options(values.estimator, folder, values.model_file)
        return make_estimator(values.estimator, self.scenario, codebook, **options)

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
        if not isinstance(action, MakeEstimator):
            super().perform(action)
        self._background.run(
            functools.partial(
                make_estimator_for, action.codebook, self._make, time.perf_counter),
            self._on_estimator)

    def _on_estimator(self, event: EstimatorMade | EstimatorFailed) -> None:
        self.tell(event)
        if isinstance(event, EstimatorMade):
            self.listen(RECEIVES)

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
