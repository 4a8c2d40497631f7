"""The executable ``optimizer``: optimises a codebook, and holds it or sends it to a network."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.parameter_service import ParameterService
from rclpy.utilities import remove_ros_args

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError, default_codebook_file
from rhs_isac_ros.codebook.__main__ import ERRORS, add_options, check
from rhs_isac_ros.codebook.__main__ import run as run_command
from rhs_isac_ros.codebook.optimize import INTERRUPTED
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import convert, parameters, topics
from rhs_isac_ros.ros.endpoints import LATCHED, create_publisher, log
from rhs_isac_ros.ros.parameters import CODEBOOK, CODEBOOK_PREFIX, same_value
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import StartError, parse, run, spin
from rhs_isac_ros.ros.session import Session
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    HelpFormatter,
    check_effect,
    input_file,
)
from rhs_isac_ros.support.exits import exit_code_of


class CodebookParameterService(ParameterService):
    """Parameter services of a node that holds a codebook.

    The service ``set_parameters`` of rclpy, which ``ros2 param load`` uses, sets parameters one by
    one. Here, it sets the parameters of the codebook together: all those in a request, or none.
    Create the node with ``start_parameter_services=False``.
    """

    def withdraw(self) -> None:
        """Destroy the services."""
        node = self._get_node()  # type: ignore[no-untyped-call]
        for service in list(node.services):
            if service.srv_type.__module__.startswith('rcl_interfaces.'):
                node.destroy_service(service)

    # Overrides the callback of rclpy's service.
    def _set_parameters_callback(
            self, request: SetParameters.Request,
            response: SetParameters.Response) -> SetParameters.Response:
        parameters = [Parameter.from_parameter_msg(message) for message in request.parameters]
        group = [p for p in parameters if p.name.startswith(CODEBOOK_PREFIX)]
        set_together = self._get_node().set_parameters_atomically  # type: ignore[no-untyped-call]
        group_result = set_together(group) if group else None
        response.results = [group_result if p in group else set_together([p]) for p in parameters]
        return response


def ros_parameters(values: Mapping[str, Any]) -> list[Parameter]:
    """Convert a mapping from names to values into ROS parameters."""
    return [Parameter(name, value=value) for name, value in values.items()]


class PushError(RuntimeError):
    """No optimizer has accepted a codebook."""


def push(session: Session, codebook: Codebook, timeout_s: float = 10.0) -> None:
    """Send a codebook to the optimizer in the namespace of a session, by setting its parameters.

    Raises PushError if no optimizer is found, or responds, within `timeout_s`, or if it rejects
    the codebook.
    """
    optimizer = f'{session.node.get_namespace().rstrip("/")}/{topics.OPTIMIZER_NODE}'
    client = AsyncParameterClient(session.node, topics.OPTIMIZER_NODE)
    if not session.spin_until(client.services_are_ready, timeout_s):
        raise PushError(f'{optimizer}: not found within {timeout_s:g} s')
    parameters = ros_parameters(codebook.to_parameters())
    response = session.response(
        lambda: client.set_parameters_atomically(parameters), timeout_s)
    if response is None:
        raise PushError(f'{optimizer}: no response within {timeout_s:g} s')
    if not response.result.successful:
        raise PushError(f'{optimizer}: codebook rejected: {response.result.reason}')


class Holder(Role):
    """The role ``optimizer``, which exchanges no messages of the protocol."""

    def react(self, event: events.Event) -> None:
        """Do nothing; the node counts the event."""


class OptimizerNode(RoleNode[Holder]):
    """Holds the codebook as parameters that can only be set together, and announces it.

    The first codebook comes from a parameter file on the command line or from ``codebook_file``.
    While a newer optimizer is present, this one withdraws its announcement. Raises CodebookError
    if the first codebook is invalid or does not fit the scenario.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__(
            topics.OPTIMIZER_NODE, start_parameter_services=False, **node_options)
        file, system = self.values.codebook_file, self.surface.system
        self._codebook = (system.codebook if system and not file
                          else Codebook.load(file or default_codebook_file()))
        defaults = self._codebook.to_parameters()
        for name, text in CODEBOOK.items():
            self.declare_parameter(name, defaults[name], ParameterDescriptor(description=text))
        given = {name: self.get_parameter(name).value for name in CODEBOOK}
        if given != defaults:
            self._codebook = Codebook.from_parameters(given)
        try:
            self._codebook.check(self.scenario)
        except CodebookError as error:
            scenario = self.values.scenario_file or self.values.system_file or 'Table I'
            raise CodebookError(
                f'codebook_file: {str(file or default_codebook_file())!r} does not fit '
                f'scenario_file {scenario!r}: {error}; set '
                'codebook_file (codebook:= of a launch) to a codebook of this scenario') from None
        # In a file of an earlier version, the provenance differs and the id may be missing.
        super().set_parameters_atomically(ros_parameters(self._codebook.to_parameters()))
        self.start(Holder(), subscribe=False)
        # Last, so that no request arrives before the parameters are declared.
        self.resume()
        self.subscribe()

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all parameters or none; a new codebook must be complete and valid.

        The codebook gets the types of the parameters, and its id if that is empty.
        """
        given = {p.name: p.value for p in parameter_list if p.name in CODEBOOK}
        if all(same_value(self.get_parameter(p.name), p)
               for p in parameter_list if p.name in given):
            return super().set_parameters_atomically(parameter_list)
        try:
            if missing := [name for name in CODEBOOK if name not in given]:
                raise CodebookError(
                    f'{", ".join(given)}: set without {", ".join(missing)}, expected the whole '
                    'codebook in one request')
            codebook = Codebook.from_parameters(given)
            codebook.check(self.scenario)
        except CodebookError as error:
            self.role.count(events.Outcome.WRONG_CODEBOOK)
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically([
            *(p for p in parameter_list if p.name not in given),
            *ros_parameters(codebook.to_parameters())])
        if result.successful:
            self._codebook = codebook
            self._publish()
        return result

    def stand_by(self) -> None:
        """Withdraw the codebook: only one optimizer may respond, as clients use one response."""
        self.destroy_publisher(self._publisher)
        self._codebook_services.withdraw()

    def resume(self) -> None:
        """Offer and announce the codebook."""
        self._codebook_services = CodebookParameterService(self)  # type: ignore[no-untyped-call]
        self._publisher = create_publisher(self, ros.Codebook, topics.CODEBOOK, LATCHED)
        self._publish()

    def _publish(self) -> None:
        codebook = self._codebook
        self.dispatch(events.CodebookOffered(codebook))
        if self.stands_by:
            return
        self._publisher.publish(convert.to_bytes(
            convert.CodebookMessage.of(codebook, self.instance, self.scenario.id),
            self.get_clock().now().nanoseconds, frame=self.frame.surface))
        log(self, f'codebook {codebook.id}: average CRLB {codebook.average_crlb_m2:.4f} m^2')


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable, and return its exit code.

    Without options, hold a codebook. With ``--push-file``, send a codebook to a running optimizer.
    With other options, optimise a codebook and write it to a file, then hold it or, with
    ``--push``, send it. The exit code is 0 on success or after a signal, 1 if a network does not
    accept the codebook, and 2 if an argument or a file is invalid.
    """
    args = sys.argv if args is None else [topics.OPTIMIZER_NODE, *args]
    parser = _parser()
    options = parse(parser, args[1:])
    parameters.check_arguments(parser, topics.OPTIMIZER_NODE, args[1:])
    if not remove_ros_args(args)[1:]:
        return run(lambda: [OptimizerNode()], args)
    check_effect(parser, options, [name for name in vars(options) if name != 'push_file'],
                 not options.push_file, 'no --push-file, which does not optimise')
    check(parser, options)
    return exit_code_of(
        lambda: _run(options, args), (*ERRORS, StartError), topics.OPTIMIZER_NODE,
        failures=(PushError,), interrupted=0)


def _run(options: argparse.Namespace, args: Sequence[str]) -> None:
    if options.push_file:
        return _push(Codebook.load(options.push_file), args)
    codebook, reason = run_command(options)
    if options.push:
        return _push(codebook, args)
    if reason != INTERRUPTED:
        overrides = ros_parameters({'codebook_file': str(options.output),
                                    'scenario_file': str(options.scenario or '')})
        spin(lambda: [OptimizerNode(parameter_overrides=overrides)], args)


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='optimizer', formatter_class=HelpFormatter,
        epilog=parameters.parameter_help(topics.OPTIMIZER_NODE),
        description='Without options, hold a codebook as parameters. With options, optimise one\n'
                    'offline, write it to a file and hold it.')
    add_options(parser)
    parser.add_argument('--push', action='store_true',
                        help='send the codebook to the optimizer of a running network and exit')
    parser.add_argument('--push-file', type=input_file, metavar='FILE',
                        help='send this codebook to a running network without optimising, '
                             'and exit')
    return parser


def _push(codebook: Codebook, args: Sequence[str]) -> None:
    with Session(['', *args]) as session:
        push(session, codebook)
    print(f'codebook {codebook.id} is set')
