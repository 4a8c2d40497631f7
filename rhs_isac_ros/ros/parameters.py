"""Every ROS parameter, declared once; descriptors, checks and documentation come from here.

``python -m rhs_isac_ros.ros.parameters`` prints the table of the README.
"""

import dataclasses
import types
from collections.abc import Mapping
from typing import Any, TypeVar

from rhs_isac_ros.model import mobility, plugins
from rhs_isac_ros.positioning import ESTIMATORS
from rhs_isac_ros.protocol.user_scheduler import POLICIES
from rhs_isac_ros.ros.parameter import Parameter, ParameterError

Settings = TypeVar('Settings')

SCENARIO = Parameter(
    'scenario_file', '', "YAML file of the scenario; empty: the paper's Table I.")
SEED = Parameter('seed', 0, 'Seed of all random numbers.', low=0, high=2**31 - 1)
STEP_TIMEOUT = Parameter(
    'step_timeout_s', 1.0, 'How long to wait for the next message of a cycle.', 's', 0.01, 60.0)

NODES: Mapping[str, tuple[Parameter, ...]] = {
    'bs': (
        SCENARIO, SEED,
        Parameter('policy', 'round_robin', 'How to select among the users that answer.',
                  choices=POLICIES, dynamic=True),
        Parameter('receiver_noise', True,
                  'Add thermal noise; false where the radio has its own.', dynamic=True),
        Parameter('ack_timeout_s', 0.1, 'How long to wait for acks.', 's', 0.001, 60.0,
                  dynamic=True),
        STEP_TIMEOUT,
        Parameter('retries', 3, 'How often a step is asked for again within step_timeout_s.',
                  low=0, high=100, dynamic=True),
        Parameter('rest_s', 0.1, 'Pause between cycles.', 's', 0.0, 3600.0, dynamic=True),
        Parameter('data_duration_s', 1e-3, 'Time that each direction transmits data.', 's',
                  1e-6, 10.0, dynamic=True),
        Parameter('allowed_users', '',
                  'Users whose acks it takes, such as 1, 4, 10-20; empty: all.', dynamic=True),
        Parameter('ack_rate_hz', 200.0, 'Acks that it takes of each user in a second.', 'Hz',
                  1.0, 1e6, dynamic=True),
        Parameter('first_cycle', 0,
                  'Number of the first cycle; 0: from the clock, so that none is repeated after '
                  'a restart.', low=0, high=2**53),
    ),
    'user': (
        SCENARIO, SEED,
        Parameter('user_id', 1, 'Number of the user.', low=1, high=2**31 - 1),
        Parameter('mobility', 'static', 'How the user moves.', choices=mobility.KINDS,
                  plugins=plugins.MOBILITIES),
        Parameter('position_m', [], 'Where it starts: x, y, z; empty: at random in the region.',
                  'm', -1e6, 1e6),
        Parameter('waypoints_m', [], 'Its way: x, y, z of one point after the other.', 'm',
                  -1e6, 1e6),
        Parameter('speed_mps', 1.0, 'Its speed, at most max_user_speed_mps of the scenario.',
                  'm/s', 0.0, 1e4),
        Parameter('ground_truth_period_s', 0.5, 'How often it tells its true position.', 's',
                  0.01, 60.0),
        STEP_TIMEOUT,
        Parameter('beacon_timeout_s', 1.5, 'Without a beacon for so long, it says so.', 's', 0.1,
                  7200.0),
    ),
    'rhs_controller': (SCENARIO,),
    'channel': (
        SCENARIO, SEED,
        Parameter('loss_probability', 0.0, 'That the air loses a signal or a packet.',
                  low=0.0, high=1.0, dynamic=True),
        Parameter('double_probability', 0.0, 'That one arrives twice.', low=0.0, high=1.0,
                  dynamic=True),
        Parameter('delay_s', 0.0, 'How long each takes at least.', 's', 0.0, 10.0, dynamic=True),
        Parameter('jitter_s', 0.0, 'How much longer at most, each at random: they overtake.', 's',
                  0.0, 10.0, dynamic=True),
    ),
    'positioner': (
        SCENARIO,
        Parameter('estimator', 'bayes', 'Estimator of the position.', choices=tuple(ESTIMATORS),
                  plugins=plugins.ESTIMATORS, dynamic=True),
        Parameter('table_folder', '',
                  "Where tables are kept between runs; empty: the user's folder for caches."),
        Parameter('model_file', '', 'Trained model; the estimator neural needs one.',
                  dynamic=True),
    ),
    'transmission': (
        SCENARIO,
        Parameter('band', -1, 'Band of the transmission, from 0; -1: in each cycle the best.',
                  low=-1, high=4095, dynamic=True),
    ),
    'optimizer': (
        SCENARIO,
        Parameter('codebook_file', '', 'Codebook to hold; empty: the one of the package.'),
    ),
    'visualizer': (
        SCENARIO,
        Parameter('period_s', 0.2, 'How often it shows the scene.', 's', 0.01, 60.0),
        Parameter('forget_s', 10.0, 'After how long without a word a user is taken away.', 's',
                  0.1, 3600.0),
    ),
    'network': (
        Parameter('users', 2, 'Number of users.', low=1, high=1000),
    ),
}


def declare(node: Any, executable: str) -> types.SimpleNamespace:
    """Declare a node's parameters and read them.

    Parameters
    ----------
    node
        The node, an `rclpy.node.Node`.
    executable
        Name of its executable, a key of `NODES`.

    Returns
    -------
    types.SimpleNamespace
        Values by name.

    Raises
    ------
    ParameterError
        If a value has the wrong type, is out of range or none of the choices.
    """
    return types.SimpleNamespace(
        **{parameter.name: _declare_one(node, parameter) for parameter in NODES[executable]})


def _declare_one(node: Any, parameter: Parameter) -> Any:
    # Here, so that the table can be read without ROS.
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
    from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
    from rclpy.parameter import Parameter as RosParameter

    default = parameter.default
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    descriptor = ParameterDescriptor(
        description=parameter.text + unit, additional_constraints=parameter.expected,
        read_only=not parameter.dynamic)
    if parameter.low is not None and type(default) is int:
        descriptor.integer_range = [
            IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high))]
    elif parameter.low is not None and type(default) is float:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=parameter.low, to_value=parameter.high)]
    # An empty list would not tell its type.
    typed = RosParameter.Type.DOUBLE_ARRAY if isinstance(default, list) else default
    try:
        value = node.declare_parameter(parameter.name, typed, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise ParameterError(
            f'{parameter.name}: {error}; expected {parameter.expected}') from None
    value = default if value is None else value
    value = list(value) if isinstance(default, list) else value
    parameter.check(value)
    return value


def settings_of(kind: type[Settings], values: types.SimpleNamespace) -> Settings:
    """Take the settings of a role from a node's parameters.

    Parameters
    ----------
    kind
        A dataclass whose fields have names of parameters.
    values
        Values by name.

    Returns
    -------
    Settings
        The settings.

    Raises
    ------
    ParameterError
        If the class refuses them.
    """
    try:
        return kind(**{field.name: getattr(values, field.name)
                       for field in dataclasses.fields(kind)})
    except ValueError as error:
        raise ParameterError(str(error)) from None


def table() -> str:
    """Write all parameters as a Markdown table.

    Returns
    -------
    str
        One row for each parameter and the executables that have it.
    """
    rows: dict[str, tuple[Parameter, list[str]]] = {}
    for executable, parameters in NODES.items():
        for parameter in parameters:
            rows.setdefault(parameter.name, (parameter, []))[1].append(executable)
    lines = ['| parameter | type | default | range | hot | nodes | what it is |',
             '|---|---|---|---|---|---|---|']
    for name, (parameter, owners) in rows.items():
        default = parameter.default
        shown = str(default).lower() if isinstance(default, bool) else default or 'empty'
        shown = default if type(default) in (int, float) else shown
        lines.append(f'| `{name}` | {parameter.kind} | {shown} | {parameter.range} | '
                     f'{"yes" if parameter.dynamic else ""} | {", ".join(owners)} | '
                     f'{parameter.text} |')
    return '\n'.join(lines)


if __name__ == '__main__':
    print(table())
