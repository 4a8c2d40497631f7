"""A user node that needs only rclpy and the messages: ``python3 docs/examples/user_node.py``."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from rhs_isac_msgs.msg import (
    Ack,
    Beacon,
    ComplexArray,
    Data,
    Grant,
    GroundTruth,
    Pilot,
    PilotRequest,
)

USER = 7
POSITION_M = 9.0, 1.0, 0.0


class PlainUser(Node):
    """Answers the messages of the base station as they arrive."""

    def __init__(self, **options):
        super().__init__('plain_user', **options)
        self._cycle = 0
        # A depth instead of a profile selects reliable and volatile, as these topics require.
        for kind, topic, callback in (
                (Beacon, 'beacon', self._on_beacon), (Grant, 'grant', self._on_grant),
                (PilotRequest, 'pilot_request', self._on_request), (Data, 'data', self._on_data)):
            self.create_subscription(kind, topic, callback, 128)
        self._ack, self._truth, self._pilot, self._data = (
            self.create_publisher(kind, topic, 128) for kind, topic in (
                (Ack, 'ack'), (GroundTruth, 'ground_truth'), (Pilot, 'pilot'), (Data, 'data')))

    def _on_beacon(self, beacon):
        if beacon.first_user <= USER <= beacon.last_user:
            self._ack.publish(Ack(cycle_id=beacon.cycle_id, user=USER))

    def _on_grant(self, grant):
        if grant.user != USER:
            return
        # The emulated channel needs the true position; the base station never receives it.
        truth = GroundTruth(cycle_id=grant.cycle_id, user=USER)
        truth.position.x, truth.position.y, truth.position.z = POSITION_M
        self._cycle = grant.cycle_id
        self._truth.publish(truth)

    def _on_request(self, request):
        if (request.user, request.cycle_id) != (USER, self._cycle):
            return
        frames = request.n_frames
        symbols = ComplexArray(shape=[frames], re=[1.0] * frames, im=[0.0] * frames)
        for band in range(request.band, request.last_band + 1):
            self._pilot.publish(
                Pilot(cycle_id=request.cycle_id, user=USER, band=band, symbols=symbols))

    def _on_data(self, data):
        if (data.user, data.cycle_id) == (USER, self._cycle) and (
                data.direction == Data.DOWNLINK and data.stage == Data.DELIVERED):
            self._data.publish(Data(
                cycle_id=data.cycle_id, user=USER, direction=Data.UPLINK, stage=Data.OFFERED,
                duration_s=data.duration_s, bits=data.bits))


if __name__ == '__main__':
    rclpy.init()
    node = PlainUser()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        # A callback that runs while a signal shuts the context down can no longer publish.
        if rclpy.ok():
            raise
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
