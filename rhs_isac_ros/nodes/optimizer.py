"""The executable ``optimizer``: holds the codebook as its parameters."""

import sys
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros import convert, parameters, qos, topics
from rhs_isac_ros.ros.resources import default_codebook_file
from rhs_isac_ros.ros.run import entry

DESCRIPTIONS = {
    'codebook.id': 'Hash of the content; must match it.',
    'codebook.shape': 'Sizes N_B, N_SB, F, K, N_E.',
    'codebook.average_crlb': 'Average Cramer-Rao bound [m^2].',
    'codebook.provenance': 'How the codebook was made.',
    'codebook.analog': 'Configurations [N_B, F, N_E], from 0 to 1.',
    'codebook.digital_re': 'Combining vectors [N_B, N_SB, F, K], real parts [sqrt(W)].',
    'codebook.digital_im': 'Combining vectors [N_B, N_SB, F, K], imaginary parts [sqrt(W)].',
}


class OptimizerNode(Node):
    """Holds the codebook, checks every change as a whole, and publishes it latched.

    A codebook comes from the node's own parameters (a parameter file on the command line) or from
    ``codebook_file``.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__(topics.OPTIMIZER_NODE, **node_options)
        values = parameters.declare(self, 'optimizer')
        self._scenario = (
            Scenario.from_yaml(values.scenario_file) if values.scenario_file else Scenario())
        self._publisher = self.create_publisher(ros.Codebook, topics.CODEBOOK, qos.LATCHED)
        defaults = Codebook.load(values.codebook_file or default_codebook_file())
        for name, value in defaults.to_parameters().items():
            self.declare_parameter(
                name, value, ParameterDescriptor(description=DESCRIPTIONS[name]))
        self._publish(self._assemble({}))
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._on_set)

    def _assemble(self, changes: dict[str, Any]) -> Codebook:
        present = {name: self.get_parameter(name).value for name in DESCRIPTIONS}
        codebook = Codebook.from_parameters(present | changes)
        codebook.check(self._scenario)
        return codebook

    def _check(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._assemble({p.name: p.value for p in changes if p.name in DESCRIPTIONS})
        except CodebookError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_set(self, changes: list[Parameter]) -> None:
        if any(p.name in DESCRIPTIONS for p in changes):
            self._publish(self._assemble({}))

    def _publish(self, codebook: Codebook) -> None:
        stamp = self.get_clock().now().to_msg()
        self._publisher.publish(convert.codebook_to_ros(codebook, stamp))
        self.get_logger().info(
            f'codebook {codebook.id}: average CRLB {codebook.average_crlb_m2:.4f} m^2')


main = entry(lambda: [OptimizerNode()])


if __name__ == '__main__':
    sys.exit(main())
