"""A node whose parameters are declared once, and some of which may change while it runs."""

import dataclasses
import types
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.ros import parameters
from rhs_isac_ros.ros.parameters import ParameterError


class SettableNode(Node):
    """Checks changes of its parameters as a whole, and hands them on as settings.

    Parameters
    ----------
    executable
        Name of the executable, and of the node unless `name` is given.
    name
        Name of the node.

    Attributes
    ----------
    values
        The parameters at the start, by name.

    Raises
    ------
    ParameterError
        If a parameter is wrong.
    """

    def __init__(self, executable: str, name: str = '', **node_options: Any) -> None:
        super().__init__(name or executable, **node_options)
        self.values = parameters.declare(self, executable)
        self._dynamic = {parameter.name: parameter for parameter in parameters.NODES[executable]
                     if parameter.dynamic}
        # The values that were set last, and what `settings` made of those checked last.
        self._set_last, self._checked = self.values, None
        self._is_restoring = False
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._on_set)

    def settings(self, values: types.SimpleNamespace) -> Any:
        """Return how the node is to work; one with parameters that may change has its own.

        Parameters
        ----------
        values
            The parameters, by name.

        Returns
        -------
        Any
            The settings, a dataclass whose fields are named as parameters.

        Raises
        ------
        ParameterError
            If they contradict each other, or do not fit the scenario or a file.
        """
        return None

    def offer(self, settings: Any) -> None:
        """Take other settings, those that `settings` made of parameters that were just set.

        Parameters
        ----------
        settings
            The settings.
        """

    def restore(self, settings: Any) -> None:
        """Have the parameters tell the settings in use, after others turned out to be of no use.

        Parameters
        ----------
        settings
            The settings in use; they are not checked again.
        """
        self._is_restoring = True
        try:
            self.set_parameters_atomically([
                Parameter(name, value=value)
                for name, value in dataclasses.asdict(settings).items() if name in self._dynamic])
        finally:
            self._is_restoring = False

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters, as the services do; the reasons of ROS name neither value nor range.

        Parameters
        ----------
        parameter_list
            The parameters.

        Returns
        -------
        rcl_interfaces.msg.SetParametersResult
            Whether they are set, and if not why.
        """
        try:
            self._check_each(parameter_list)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(parameter_list)

    def _mine(self, changes: Iterable[Parameter]) -> dict[str, Any]:
        return {p.name: p.value for p in changes if p.name in self._dynamic}

    def _check_each(self, changes: Iterable[Parameter]) -> None:
        for name, value in self._mine(changes).items():
            self._dynamic[name].check(value)

    def _with(self, changes: Iterable[Parameter]) -> types.SimpleNamespace:
        return types.SimpleNamespace(**{**vars(self._set_last), **self._mine(changes)})

    def _check(self, changes: list[Parameter]) -> SetParametersResult:
        if self._mine(changes) and not self._is_restoring:
            try:
                self._check_each(changes)
                self._checked = self.settings(self._with(changes))
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_set(self, changes: list[Parameter]) -> None:
        if not self._mine(changes):
            return
        self._set_last = self._with(changes)
        if not self._is_restoring:
            self.offer(self._checked)
