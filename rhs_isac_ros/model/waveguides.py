"""Admittances of a board of waveguides with coupled dipoles.

Each row of elements is cut into the upper wall of a rectangular waveguide, whose only mode is
TE10. The guide begins at the feed and is closed at both ends. The elements are magnetic dipoles
across the guide. All of them couple through the air above the conducting plane of the board, those
of a guide also through the guide. Several guides are connected in parallel to a feed.

The model is that of Williams, Ramirez-Espinosa, Yuan and de Carvalho, Electromagnetic based
communication model for dynamic metasurface antennas, IEEE Trans. Wireless Commun., 2022, with
losses and a dielectric in the guides.
"""

import dataclasses

import numpy as np

from rhs_isac_ros.model import geometry
from rhs_isac_ros.model.constants import NEPERS_PER_DB, SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.support.fields import Field, finite

_PERMEABILITY = 1.25663706212e-6
_IMPEDANCE_OHM = _PERMEABILITY * SPEED_OF_LIGHT_MPS
# At the walls, the field of the mode is 0.
_ACROSS = Field(float, low=1e-3, high=0.999)


@dataclasses.dataclass(frozen=True)
class Guides:
    """Waveguides of one cross-section; distances along a guide begin at its feed."""

    width_m: float
    height_m: float
    length_m: float
    refractive_index: float = 1.0
    loss_db_per_m: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError unless the numbers are positive."""
        for field in dataclasses.fields(self):
            finite(field.name, getattr(self, field.name), 0.0)

    def admittance(self, frequency_hz: float, first_m: np.ndarray, second_m: np.ndarray
                   ) -> np.ndarray:
        """Return the admittance between unit dipoles in a guide [S], complex128.

        Raises ValueError if the guide carries no wave at the frequency.
        """
        wavenumber = 2 * np.pi * frequency_hz * self.refractive_index / SPEED_OF_LIGHT_MPS
        if wavenumber * self.width_m <= np.pi:
            raise ValueError(f'width_m: {self.width_m:g} with {frequency_hz:g} Hz, expected more '
                             f'than {np.pi / wavenumber:.4g}, half a wavelength in the guide')
        along = np.sqrt(wavenumber**2 - (np.pi / self.width_m)**2) - (
            1j * NEPERS_PER_DB * self.loss_db_per_m)
        reactance = 2 * np.pi * frequency_hz * _PERMEABILITY
        size = 2 * along / (self.width_m * self.height_m * reactance)
        nearer, farther = np.minimum(first_m, second_m), np.maximum(first_m, second_m)
        return (-1j * size * np.cos(along * nearer) * np.cos(along * (self.length_m - farther))
                / np.sin(along * self.length_m))


def air_admittance(frequency_hz: float, offsets_m: np.ndarray) -> np.ndarray:
    """Return the admittance [S] between unit dipoles along z on a plane, at offsets [..., 3].

    At the offset 0, it is the radiation conductance of a dipole.
    """
    wavenumber = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_MPS
    distances = np.linalg.norm(offsets_m, axis=-1)
    apart = np.where(distances > 0, distances, 1.0)
    x, square = wavenumber * apart, (offsets_m[..., 2] / apart)**2
    relative = 1.5j * np.exp(-1j * x) / x * (
        1 - square - (1 - 3 * square) * (1j / x + 1 / x**2))
    return wavenumber**2 / (3 * np.pi * _IMPEDANCE_OHM) * np.where(distances > 0, relative, 1)


def admittances(frequencies_hz: np.ndarray, guides: Guides, along_m: np.ndarray,
                elements_m: np.ndarray, guide_of: np.ndarray, feed_of: np.ndarray,
                across: float = 0.5) -> dict[str, np.ndarray]:
    """Compute the admittances of a board, as arrays of a file for `network`.

    Parameters
    ----------
    along_m
        Distance of each element along its guide, float64 [N_E].
    elements_m
        Positions of the elements, float64 [N_E, 3]; dipoles are along z.
    guide_of, feed_of
        Number of each element's guide, int [N_E], and of each guide's feed, int [guides].
    across
        Position of the elements between the walls of a guide, from 0 to 1. The field of the mode,
        and with it the coupling to and through the guide, is strongest in the middle.
    """
    n_feeds, n = int(feed_of.max()) + 1, len(along_m)
    of_feed = np.equal.outer(feed_of[guide_of], np.arange(n_feeds))
    same = guide_of[:, None] == guide_of
    offsets = elements_m[:, None] - elements_m
    reach = np.sin(np.pi * _ACROSS.checked('across', across))
    found: dict[str, list[np.ndarray]] = {'y_tt': [], 'y_st': [], 'y_ss': []}
    for frequency in frequencies_hz.tolist():
        to_feed = guides.admittance(frequency, np.zeros(n), along_m)
        own = guides.admittance(frequency, np.zeros(1), np.zeros(1))
        found['y_tt'].append(np.diag(own * np.bincount(feed_of)))
        found['y_st'].append(reach * to_feed[:, None] * of_feed)
        found['y_ss'].append(
            air_admittance(frequency, offsets)
            + reach**2 * same * guides.admittance(frequency, along_m[:, None], along_m))
    return {'frequency_hz': frequencies_hz, **{
        name: np.stack(arrays) for name, arrays in found.items()}}


def board_of_guides(scenario: Scenario, loss_db_per_m: float = 3.0, across: float = 0.07
                    ) -> dict[str, np.ndarray]:
    """Compute the board of a scenario with one guide for each row of elements.

    Guides are as wide as the rows are apart, and a third as high; they contain the material of the
    board. Neighbouring rows share a feed. The loads lose 5 % of the power that an element radiates
    at the centre of the first band, and tune by 8 times its conductance. `y_st` is
    scaled so that the coefficients of single elements at resonance have the RMS 1. Raises
    ValueError if the guides carry no wave.
    """
    if scenario.element_positions_m is not None:
        raise ValueError('element_positions_m: not null, expected a grid of elements')
    elements, shape = geometry.element_positions(scenario), (scenario.n_rows, scenario.n_columns)
    if scenario.n_feeds > shape[0]:
        raise ValueError(f'n_feeds: {scenario.n_feeds}, expected at most one for each of '
                         f'{shape[0]} rows of elements')
    spacing, width = geometry.element_intervals_m(scenario).tolist()
    guides = Guides(width, width / 3, (shape[1] + 1) * spacing, scenario.refractive_index,
                    loss_db_per_m)
    along = elements[:, 1] - elements[:, 1].min() + spacing
    rows = np.arange(shape[0])
    arrays = admittances(
        # The ends of a band suffice, because the transfer is interpolated.
        np.unique(geometry.subband_frequencies_hz(scenario)[:, [0, -1]]), guides, along, elements,
        np.repeat(rows, shape[1]), rows * scenario.n_feeds // shape[0], across)
    conductance = air_admittance(min(scenario.center_frequencies_hz), np.zeros(3)).real
    own = np.diagonal(arrays['y_ss'], axis1=1, axis2=2).real + 0.05 * conductance
    alone = arrays['y_st'] / own[..., None]
    # Power waves of a feed do not depend on the unit of its voltage.
    scale = 1 / np.sqrt(np.mean(np.abs(alone[np.abs(alone) > 0])**2))
    arrays['y_st'] = arrays['y_st'] * scale
    arrays['y_tt'] = arrays['y_tt'] * scale**2
    return {**arrays, 'load_conductance_s': 0.05 * conductance,
            'load_susceptance_slope_s': 8.0 * conductance}
