"""Where nodes get the codebook: the parameters of the optimizer."""

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
from rhs_isac_ros.ros.timers import steady_timer

_NAMES = ['codebook.id', 'codebook.shape', 'codebook.average_crlb', 'codebook.provenance',
          'codebook.analog', 'codebook.digital_re', 'codebook.digital_im']
_RETRY_S = 0.1
_ANSWER_S = 2.0


class CodebookSource:
    """Fetches the codebook through the parameter services and follows its changes.

    The latched topic tells of a new codebook, also after the optimizer was restarted; what counts
    is the content of the parameters.

    Parameters
    ----------
    node
        The node that needs it.
    scenario
        The scenario that it must fit.
    on_codebook
        Called with each new codebook.
    on_holder
        Called with whether the optimizer is there, when that changes after it was there.
    """

    def __init__(
            self, node: Node, scenario: Scenario, on_codebook: Callable[[Codebook], None],
            on_holder: Callable[[bool], None] = lambda there: None) -> None:
        self._node, self._scenario = node, scenario
        self._on_codebook, self._on_holder = on_codebook, on_holder
        self._held = True
        # Of the parameter services, only this one: a policy need not allow the others.
        self._client = node.create_client(
            GetParameters, f'{topics.OPTIMIZER_NODE}/get_parameters')
        # Counts the offers; an answer that was asked for before the last one is out of date.
        self._wanted, self._fetched, self._asked = 1, 0, 0
        self._asked_s = -math.inf
        self._complaint = ''
        self._known = ''
        node.create_subscription(
            ros.Codebook, topics.CODEBOOK, self._on_offer, qos.HELD, raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                liveliness=self._on_liveliness, use_default_callbacks=False))
        self._timer = steady_timer(node, _RETRY_S, self._ask)

    def _on_offer(self, content: bytes) -> None:
        # What it says does not matter, not even whether it can be decoded.
        # Even if the id is known: a change that is taken back must not stay.
        self._wanted += 1
        self._timer.reset()

    def _on_liveliness(self, event: Any) -> None:
        held = event.alive_count > 0 or self._is_at_home()
        if held == self._held:
            return
        self._held = held
        self._on_holder(held)
        if held:
            self._node.get_logger().info(f'{self._owner} is back')
        else:
            self._node.get_logger().warning(
                f'{self._owner} is gone; {self._known or "no codebook"} stays in use')

    def _is_at_home(self) -> bool:
        """Whether the optimizer is in this process, where Fast DDS takes everybody for dead.

        The first twelve bytes of an endpoint's identity are those of its participant, of which
        every process has one.
        """
        topic = self._node.resolve_topic_name(topics.CODEBOOK)
        name = self._node.get_name(), self._node.get_namespace()
        mine = {bytes(info.endpoint_gid[:12])
                for info in self._node.get_subscriptions_info_by_topic(topic)
                if (info.node_name, info.node_namespace) == name}
        return any(bytes(info.endpoint_gid[:12]) in mine
                   for info in self._node.get_publishers_info_by_topic(topic))

    @property
    def _owner(self) -> str:
        return f'{self._node.get_namespace().rstrip("/")}/{topics.OPTIMIZER_NODE}'

    def _ask(self) -> None:
        if self._fetched == self._wanted:
            self._timer.cancel()
            return
        now_s = time.monotonic()
        waiting = self._asked == self._wanted and now_s - self._asked_s < _ANSWER_S
        if not waiting and self._client.service_is_ready():
            self._asked, self._asked_s = self._wanted, now_s
            future = self._client.call_async(GetParameters.Request(names=_NAMES))
            future.add_done_callback(functools.partial(self._on_answer, self._wanted))

    def _on_answer(self, asked: int, future: Any) -> None:
        values = future.result().values if future.exception() is None else ()
        if asked != self._wanted or len(values) != len(_NAMES):
            return
        self._fetched = asked
        try:
            codebook = Codebook.from_parameters(
                dict(zip(_NAMES, map(parameter_value_to_python, values), strict=True)))
            codebook.check(self._scenario)
        except CodebookError as error:
            self._complain(str(error))
            return
        self._complaint = ''
        if codebook.id != self._known:
            self._known = codebook.id
            self._on_codebook(codebook)

    def _complain(self, text: str) -> None:
        if text != self._complaint:
            self._complaint = text
            self._node.get_logger().error(f'codebook of {self._owner} not used: {text}')
