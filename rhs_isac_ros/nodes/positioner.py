"""The executable ``positioner``: estimates the user's position."""

import sys
import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.positioning import Estimator, make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.codebook_source import CodebookSource
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class PositionerNode(RoleNode):
    """The positioner; it listens to received signals once its tables are built."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('positioner', (m.PositionEstimate,), **node_options)
        self._pose = self.create_publisher(
            PoseWithCovarianceStamped, topics.POSITION, qos.EXCHANGE)
        self.start(Positioner(self.scenario, self._make, time.perf_counter), ())
        self._codebook = CodebookSource(self, self.scenario, self._on_codebook)

    def _make(self, codebook: Codebook) -> Estimator:
        return make_estimator(self.values.estimator, self.scenario, codebook)

    def _on_codebook(self, codebook: Codebook) -> None:
        self.tell(CodebookOffered(codebook))
        self.listen((m.ReceivedSignals,))

    def publish(self, message: m.Message) -> bool:
        """Publish an estimate, and the same as a standard pose.

        Parameters
        ----------
        message
            The estimate.

        Returns
        -------
        bool
            Whether it was published.
        """
        sent = super().publish(message)
        if sent:
            self._pose.publish(convert.pose(message, self.get_clock().now().to_msg()))
        return sent


main = entry(lambda: [PositionerNode()])


if __name__ == '__main__':
    sys.exit(main())
