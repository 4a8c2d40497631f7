"""A client that fetches the codebook from the parameters of the optimizer."""

import contextlib
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.diagnostics import LogOnce
from rhs_isac_ros.ros.endpoints import LATCHED, create_or_refuse, steady_timer, subscribe
from rhs_isac_ros.ros.parameters import CODEBOOK

_NAMES = list(CODEBOOK)
_RETRY_S = 0.1
_RESPONSE_TIMEOUT_S = 2.0


class CodebookClient:
    """Fetches the codebook from the parameters of the optimizer whenever it changes.

    A message on the latched topic announces the codebook and triggers a request to the parameter
    service. Two optimizers have the same services, and either may answer. The announced codebook,
    whose id proves its content, therefore replaces a response with another codebook or a missing
    response. The optimizers agree on which of them announces; see `Presences`.

    Attributes
    ----------
    codebook_id
        Id of the latest codebook; empty before the first.
    """

    def __init__(
            self, node: Node, scenario: Scenario, on_codebook: Callable[[Codebook], None]
    ) -> None:
        self._node, self._scenario, self._on_codebook = node, scenario, on_codebook
        # Only one of the parameter services, so that a security policy need not allow the others.
        name = f'{topics.OPTIMIZER_NODE}/get_parameters'
        self._client = create_or_refuse(
            node, f'client of {name}', lambda: node.create_client(GetParameters, name))
        # Serial numbers of announcements. A response is stale if its request was sent before the
        # latest announcement.
        self._announced, self._requested, self._fetched = 0, 0, 0
        self._announced_s = math.inf
        self._announcement: Codebook | None = None
        self._log_once = LogOnce(node)
        self.codebook_id = ''
        subscribe(
            node, ros.Codebook, topics.CODEBOOK, self._on_announcement, LATCHED, raw=True)
        self._timer = steady_timer(node, _RETRY_S, self._request)

    def _on_announcement(self, content: bytes) -> None:
        try:
            message = convert.from_bytes(convert.CodebookMessage, content)
            codebook = message.codebook()
        # Anything may be published on the topic.
        except ValueError:
            return
        if message.codebook_id != codebook.id or not self._fits(message, codebook):
            return
        # Send the request even if the id is unchanged, because a response with a withdrawn
        # codebook may be in transit.
        self._announcement = codebook
        self._announced += 1
        self._announced_s = time.monotonic()
        self._timer.reset()
        self._request()

    def _fits(self, message: convert.CodebookMessage, codebook: Codebook) -> bool:
        """Return whether a codebook fits the scenario, or log that it does not."""
        try:
            codebook.check(self._scenario)
            if message.scenario_id not in ('', self._scenario.id):
                raise CodebookError(
                    f'scenario {message.scenario_id}, expected {self._scenario.id}')
        except CodebookError as error:
            self._log_once.error(
                'codebook', f'codebook of the optimizer rejected: {error}',
                repeat_if_changed=True)
            return False
        self._log_once.clear('codebook')
        return True

    def _request(self) -> None:
        if self._fetched == self._announced:
            self._timer.cancel()
            return
        if time.monotonic() - self._announced_s > _RESPONSE_TIMEOUT_S:
            self._use(())
        elif (self._client is not None and self._requested != self._announced
                and self._client.service_is_ready()):
            self._requested = self._announced
            future = self._client.call_async(GetParameters.Request(names=_NAMES))
            future.add_done_callback(functools.partial(self._on_response, self._announced))

    def _on_response(self, serial: int, future: Any) -> None:
        values = future.result().values if future.exception() is None else ()
        if serial == self._announced:
            self._use(values)

    def _use(self, values: Sequence[ParameterValue]) -> None:
        """Use the codebook of a response, if it is the announced one, or that itself."""
        self._fetched = self._announced
        assert self._announcement
        codebook = self._announcement
        # An invalid or incomplete response is not the announced codebook.
        with contextlib.suppress(CodebookError, ValueError):
            fetched = Codebook.from_parameters(
                dict(zip(_NAMES, map(parameter_value_to_python, values), strict=True)))
            codebook = fetched if fetched.id == codebook.id else codebook
        if codebook.id != self.codebook_id:
            self.codebook_id = codebook.id
            self._on_codebook(codebook)
