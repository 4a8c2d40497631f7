"""The executable ``transmission``: steers the beam and reports the capacity."""

import types
from typing import Any

from rhs_isac_ros.link import prepare_steering
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.ros.parameters import calibrated_surface
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support.fields import ParameterError


class TransmissionNode(RoleNode[Transmission]):
    """The ROS node of the role ``transmission``, which serves once it has a codebook."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('transmission', **node_options)
        # Surfaces by calibration file, as read when the parameter was checked.
        self._surfaces: dict[str, SurfaceEstimate | None] = {}
        settings = self.make_settings(self.values)
        self.start(Transmission(self.scenario, settings, self._surfaces.__getitem__,
                                library=self.library), needs_codebook=True)

    def make_settings(self, values: types.SimpleNamespace) -> Any:
        """Return the settings; raise ParameterError for an invalid value or calibration file."""
        n_bands = self.scenario.n_bands
        if values.band >= n_bands:
            raise ParameterError(
                f'band: {values.band}, expected 0 to {n_bands - 1} of the scenario, or -1')
        surface = calibrated_surface(values, self.surface)
        self._surfaces[values.calibration_file] = surface
        prepare_steering(self.scenario, surface)
        return super().make_settings(values)


main = entry('transmission', lambda: [TransmissionNode()])
