"""The executable ``channel``: surface and radio, and the emulated radio channel."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from rclpy.impl.logging_severity import LoggingSeverity

from rhs_isac_ros.frontend import Air, FrontEnd, Radio, SampleRecorder, make_radio, make_surface
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol.channel import Channel, apply_patterns
from rhs_isac_ros.ros.endpoints import BackgroundWorker, log, surviving
from rhs_isac_ros.ros.parameters import calibrated_surface
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import parse_options
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError

_Result = TypeVar('_Result')


def _run_at_once(job: Callable[[], _Result], on_result: Callable[[_Result], None]) -> None:
    """Replace `BackgroundWorker.run` for jobs that wait for nothing."""
    on_result(job())


class ChannelNode(RoleNode[Channel]):
    """The ROS node of the surface, the radio, the emulated channel and its impairments.

    While the node stands by, it releases surface and radio, which another node may then use.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', **node_options)
        values = self.values
        air = Air(self.scenario, streams.generator(values.seed, streams.RADIO))
        surface = self._make('surface', make_surface, self.scenario.n_elements)
        radio = self._make('radio', make_radio, self.scenario, air)
        self._front_end = FrontEnd(surface, radio, air, self._recorder(radio))
        worker = BackgroundWorker(self)
        self._run = worker.run if self._front_end.waits else _run_at_once
        # In reverse order: the worker ends before the front end is closed.
        self.endings.callback(self._release)
        self.endings.callback(worker.close)
        self.start(Channel(
            self.scenario, values.seed, self.make_settings(values),
            calibrated_surface(values, self.surface, 'states_file')))
        log(self, f'serving: {self.scenario.n_bands} bands, {self.scenario.n_elements} elements, '
            f'surface {values.surface}, radio {values.radio}')

    def _make(self, kind: str, make: Callable[..., _Result], *arguments: Any) -> _Result:
        """Return the surface or the radio that the parameters `kind` and its options select."""
        with translated(ValueError, ParameterError, f'{kind}_options'):
            options = parse_options(getattr(self.values, f'{kind}_options'))
        with translated(ValueError, ParameterError, kind):
            return make(getattr(self.values, kind), *arguments, **options)

    def _recorder(self, radio: Radio) -> SampleRecorder | None:
        if not self.values.samples_folder:
            return None
        with translated(ValueError, ParameterError, 'samples_folder'):
            return SampleRecorder(
                self.values.samples_folder, self.scenario, radio.modem,
                functools.partial(log, self, severity=LoggingSeverity.ERROR))

    def execute(self, action: events.Action) -> None:
        """Show configurations, and measure them."""
        if not isinstance(action, events.ApplyPatterns):
            super().execute(action)
            return
        self._run(functools.partial(apply_patterns, self._front_end, action), self.dispatch)

    def details(self) -> Mapping[str, str]:
        """Return the diagnostics of the radio."""
        found: Mapping[str, str] = {}
        with surviving(self):
            found = self._front_end.status()
        return found

    def stand_by(self) -> None:
        """Release surface and radio after the request in progress."""
        self._run(self._release, lambda _: None)

    def _release(self) -> None:
        # A driver of another package may raise any exception.
        try:
            self._front_end.close()
        except Exception as error:
            log(self, f'surface or radio not released: {type(error).__name__}: {error}',
                LoggingSeverity.WARN)


main = entry('channel', lambda: [ChannelNode()])
