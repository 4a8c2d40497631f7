"""A client that fetches the codebook from the parameters of the optimizer."""

import functools
import math
import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros import qos, topics
from rhs_isac_ros.ros.log_once import LogOnce
from rhs_isac_ros.ros.parameters import CODEBOOK
from rhs_isac_ros.ros.timers import steady_timer

_NAMES = list(CODEBOOK)
_RETRY_S = 0.1
_RESPONSE_TIMEOUT_S = 2.0


class CodebookClient:
    """Fetches the codebook from the parameters of the optimizer whenever it changes.

    A message on the latched topic only triggers a request, including after a restart of the
    optimizer; the codebook itself comes from the parameter service.

    Parameters
    ----------
    scenario
        Scenario that the codebook must fit.
    on_codebook
        Called with each new codebook.
    on_presence
        Called with True or False whenever the optimizer appears or disappears; it is assumed to be
        present at first.
    """

    def __init__(
            self, node: Node, scenario: Scenario, on_codebook: Callable[[Codebook], None],
            on_presence: Callable[[bool], None] = lambda present: None) -> None:
        self._node, self._scenario = node, scenario
        self._on_codebook, self._on_presence = on_codebook, on_presence
        self._is_present = True
        # Only one of the parameter services, so that a security policy need not allow the others.
        self._client = node.create_client(
            GetParameters, f'{topics.OPTIMIZER_NODE}/get_parameters')
        # Serial numbers of announcements. A response is stale if its request was sent before the
        # latest announcement.
        self._announced, self._requested, self._fetched = 1, 0, 0
        self._requested_s = -math.inf
        self._log_once = LogOnce(node)
        self._codebook_id = ''
        node.create_subscription(
            ros.Codebook, topics.CODEBOOK, self._on_announcement, qos.LATCHED_WITH_LEASE, raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                liveliness=self._on_liveliness, use_default_callbacks=False))
        self._timer = steady_timer(node, _RETRY_S, self._request)

    def _on_announcement(self, content: bytes) -> None:
        # Ignore the content, which may be malformed. Send the request even if the id is unchanged,
        # because a response with a withdrawn codebook may be in transit.
        self._announced += 1
        self._timer.reset()

    def _on_liveliness(self, event: Any) -> None:
        present = event.alive_count > 0 or self._is_in_this_process()
        if present == self._is_present:
            return
        self._is_present = present
        self._on_presence(present)
        if present:
            self._node.get_logger().info(f'{self._optimizer} is present again')
        else:
            self._node.get_logger().warning(
                f'{self._optimizer} is no longer present; '
                f'the codebook in use is {self._codebook_id or "none"}')

    def _is_in_this_process(self) -> bool:
        """Return whether the optimizer is in this process; Fast DDS then reports it as lost.

        The first twelve bytes of the GID of an endpoint identify its participant, and each process
        has one participant.
        """
        topic = self._node.resolve_topic_name(topics.CODEBOOK)
        name = self._node.get_name(), self._node.get_namespace()
        participants = {bytes(info.endpoint_gid[:12])
                        for info in self._node.get_subscriptions_info_by_topic(topic)
                        if (info.node_name, info.node_namespace) == name}
        return any(bytes(info.endpoint_gid[:12]) in participants
                   for info in self._node.get_publishers_info_by_topic(topic))

    @property
    def _optimizer(self) -> str:
        return f'{self._node.get_namespace().rstrip("/")}/{topics.OPTIMIZER_NODE}'

    def _request(self) -> None:
        if self._fetched == self._announced:
            self._timer.cancel()
            return
        now_s = time.monotonic()
        is_pending = (self._requested == self._announced
                      and now_s - self._requested_s < _RESPONSE_TIMEOUT_S)
        if not is_pending and self._client.service_is_ready():
            self._requested, self._requested_s = self._announced, now_s
            future = self._client.call_async(GetParameters.Request(names=_NAMES))
            future.add_done_callback(functools.partial(self._on_response, self._announced))

    def _on_response(self, serial: int, future: Any) -> None:
        values = future.result().values if future.exception() is None else ()
        if serial != self._announced or len(values) != len(_NAMES):
            return
        self._fetched = serial
        try:
            codebook = Codebook.from_parameters(
                dict(zip(_NAMES, map(parameter_value_to_python, values), strict=True)))
            codebook.check(self._scenario)
        except CodebookError as error:
            self._log_once.error(
                'codebook', f'codebook of {self._optimizer} rejected: {error}',
                repeat_if_changed=True)
            return
        self._log_once.clear('codebook')
        if codebook.id != self._codebook_id:
            self._codebook_id = codebook.id
            self._on_codebook(codebook)
