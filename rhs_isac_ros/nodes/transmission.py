"""The executable ``transmission``: steers the beam and reports the capacity."""

import sys
import types
from typing import Any

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol.events import CodebookOffered
from rhs_isac_ros.protocol.settings import TransmissionSettings
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.ros.parameters import ParameterError, settings_of
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class TransmissionNode(RoleNode):
    """The transmission phase; it listens to estimates once it has a codebook."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('transmission', (), **node_options)
        self.start(Transmission(self.scenario, self.settings(self.values)), ())
        self.follow_codebook(self._on_codebook)

    def settings(self, values: types.SimpleNamespace) -> TransmissionSettings:
        """Return which band to use.

        Parameters
        ----------
        values
            The parameters, by name.

        Returns
        -------
        TransmissionSettings
            The settings.

        Raises
        ------
        ParameterError
            If the scenario has no such band.
        """
        n_bands = self.scenario.n_bands
        if values.band >= n_bands:
            raise ParameterError(
                f'band: {values.band}, expected 0 to {n_bands - 1} of the scenario, or -1')
        return settings_of(TransmissionSettings, values)

    def _on_codebook(self, codebook: Codebook) -> None:
        self.dispatch(CodebookOffered(codebook))
        self.advertise(Transmission.SENDS)
        self.listen(Transmission.RECEIVES)


main = entry(lambda: [TransmissionNode()])


if __name__ == '__main__':
    sys.exit(main())
