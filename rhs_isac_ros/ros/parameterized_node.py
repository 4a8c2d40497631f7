"""A node with declared parameters, some of which may change while it runs."""

import dataclasses
import functools
import types
from collections.abc import Iterable
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.ros import parameters, topics
from rhs_isac_ros.ros.endpoints import create_or_refuse, refusals
from rhs_isac_ros.ros.parameters import ParameterError

_FLOATING = (Parameter.Type.DOUBLE, Parameter.Type.DOUBLE_ARRAY)


def same_value(one: Parameter, other: Parameter) -> bool:
    """Return whether two parameters have the same type and value; NaN equals NaN."""
    return one.type_ == other.type_ and bool(np.array_equal(
        one.value, other.value, equal_nan=one.type_ in _FLOATING))


class ParameterizedNode(Node):
    """A node that checks each change of its parameters as a whole and converts it to settings.

    Parameters
    ----------
    executable
        Name of the executable, which determines the parameters.
    name
        Name of the node; by default that of the executable.

    Attributes
    ----------
    values
        Initial values of the parameters, by name.

    Raises
    ------
    ParameterError
        If a parameter is invalid.
    """

    def __init__(self, executable: str, name: str = '', **node_options: Any) -> None:
        super().__init__(name or executable, **node_options)
        self.values = parameters.declare(self, executable)
        self._dynamic = {parameter.name: parameter for parameter in parameters.NODES[executable]
                         if parameter.dynamic}
        self._current_values = self.values
        # The settings made by the last check; the change that was checked may still be rejected.
        self._checked_settings: Any = None
        self._is_reverting = False
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._on_set)

    def make_settings(self, values: types.SimpleNamespace) -> Any:
        """Return the settings for parameter values; nodes with dynamic parameters override this.

        Returns
        -------
        Any
            A dataclass whose fields have the names of parameters.

        Raises
        ------
        ParameterError
            If the values contradict each other, the scenario or a file.
        """
        return None

    def on_settings_changed(self, settings: Any) -> None:
        """Handle new settings, made from parameters that were just set."""

    def revert_parameters(self, settings: Any) -> None:
        """Set the parameters back to the settings in use, which are not checked again."""
        self._is_reverting = True
        try:
            self.set_parameters_atomically([
                Parameter(name, value=value)
                for name, value in dataclasses.asdict(settings).items() if name in self._dynamic])
        finally:
            self._is_reverting = False

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters together, as the parameter services do.

        Unlike that of rclpy, the reason for a rejection states the value and the valid range, and
        read-only parameters may be given if they keep their values, as in a dump of the node.
        """
        parameter_list = [p for p in parameter_list if not self._is_kept(p)]
        if not parameter_list:
            return SetParametersResult(successful=True)
        try:
            self._check_each(parameter_list)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        # With use_sim_time, rclpy subscribes to the time of the simulation.
        result = create_or_refuse(self, f'subscription to {topics.CLOCK}', functools.partial(
            super().set_parameters_atomically, parameter_list))
        if result:
            return result
        self._time_source.ros_time_is_active = False
        return SetParametersResult(
            successful=False, reason=refusals(self)[f'subscription to {topics.CLOCK}'])

    def _is_kept(self, parameter: Parameter) -> bool:
        """Return whether a parameter is read-only and keeps its value."""
        name = parameter.name
        return (self.has_parameter(name) and self.describe_parameter(name).read_only
                and same_value(self.get_parameter(name), parameter))

    def _dynamic_values(self, changes: Iterable[Parameter]) -> dict[str, Any]:
        return {p.name: p.value for p in changes if p.name in self._dynamic}

    def _check_each(self, changes: Iterable[Parameter]) -> None:
        for name, value in self._dynamic_values(changes).items():
            self._dynamic[name].check(value)

    def _with(self, changes: Iterable[Parameter]) -> types.SimpleNamespace:
        return types.SimpleNamespace(
            **{**vars(self._current_values), **self._dynamic_values(changes)})

    def _check(self, changes: list[Parameter]) -> SetParametersResult:
        if self._dynamic_values(changes) and not self._is_reverting:
            try:
                self._check_each(changes)
                self._checked_settings = self.make_settings(self._with(changes))
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_set(self, changes: list[Parameter]) -> None:
        if not self._dynamic_values(changes):
            return
        self._current_values = self._with(changes)
        if not self._is_reverting:
            self.on_settings_changed(self._checked_settings)
