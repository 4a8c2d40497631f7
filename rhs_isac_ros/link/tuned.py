"""Search for a beam on any board, also with coupling, by the gradient of the capacity.

The searches of `steering` require coefficients that are affine in the tunings, such as amplitudes
or two states. On other boards, L-BFGS-B climbs in the tunings of all elements, from a focused beam
if elements have coefficients of their own. The steps are few, because the data of a cycle wait for
the beam; three more starts and 60 steps would gain 1 % with resonances and 3 % with coupling. If
tunings are discrete, they are then exchanged as long as this increases the capacity.
"""

import dataclasses

import numpy as np

from rhs_isac_ros.link.band_link import Link, representative_subbands, water_filling
from rhs_isac_ros.link.capacity import Beamformer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import adjoint, checked_position
from rhs_isac_ros.model.board import Board, BoardError, Ports
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import spatial_covariance
from rhs_isac_ros.model.surface import NOMINAL, Response, on_levels, ports_of

# Numbers of steps and of exchanges.
_N_STEPS, _N_EXCHANGES = 20, 40
# Drift of phases between sub-bands of the search, and largest number of these sub-bands.
_MAX_DRIFT_RAD, _MAX_SUBBANDS = 0.05, 4
# Smallest relative increase of the capacity that justifies an exchange.
_MIN_GAIN = 1e-9


def tuned_beam(scenario: Scenario, position: np.ndarray, band: int,
               surface: SurfaceEstimate | None) -> Beamformer:
    """Find a beam that nearly maximises Eq. (10) for a user at a position, float64 [3] [m]."""
    from scipy.optimize import minimize

    whole = TunedLink.to(scenario, position, band, surface)
    link = whole.at_subbands(representative_subbands(scenario, _MAX_DRIFT_RAD, _MAX_SUBBANDS))
    try:
        start = scenario.board.focused(whole.ports, whole.response[0] * whole.los[0])
    except BoardError:
        # With coupling, no element has a best tuning of its own.
        start = np.full(scenario.n_elements, 0.5)

    def loss(tunings: np.ndarray) -> tuple[float, np.ndarray]:
        rate, gradient = link.rate_and_gradient(tunings)
        return -rate, -gradient

    end = minimize(loss, start, jac=True, method='L-BFGS-B', bounds=[(0.0, 1.0)] * len(start),
                   options={'maxiter': _N_STEPS}).x
    best = link.exchanged(on_levels(scenario, end), scenario.amplitude_levels)
    return Beamformer(best, whole.best_digital(best)[0, 0], band)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class TunedLink(Link):
    """The link between a surface and one position in a band, for any board."""

    board: Board
    ports: Ports
    response: Response

    @classmethod
    def to(cls, scenario: Scenario, position: np.ndarray, band: int,
           surface: SurfaceEstimate | None) -> 'TunedLink':
        """Return the link to a position, float64 [3] [m]."""
        slope, offset, gains = NOMINAL if surface is None else surface.response
        return cls(
            board=scenario.board, ports=ports_of(scenario, band),
            response=(slope, offset, np.ravel(gains)[band % np.size(gains)]),
            los=los_gain(scenario, checked_position(position)[None], band),
            spatial=spatial_covariance(scenario)[band:band + 1],
            noise_power_w=scenario.noise_power_w, power_w=scenario.max_power_w)

    def channels(self, analog: np.ndarray) -> np.ndarray:
        """Return the transfer of the board with the response; see `Link.channels`."""
        slope, offset, gain = self.response
        tunings = np.reshape(analog, (1, -1, analog.shape[-1]))
        return gain * np.swapaxes(self.board.channels(self.ports, tunings, slope, offset), 1, 2)

    def at_subbands(self, subbands: np.ndarray) -> 'TunedLink':
        """Return the link in a subset of the sub-bands; see `Link.at_subbands`."""
        return dataclasses.replace(super().at_subbands(subbands), ports=dataclasses.replace(
            self.ports, frequencies_hz=self.ports.frequencies_hz[:, subbands]))

    def rate_and_gradient(self, tunings: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the capacity of tunings [N_E], and its gradient [N_E].

        The digital part is the best one, so its changes do not contribute to the gradient.
        """
        feeds = self.feeds(tunings)
        gains, power, directions = self.eigenbeams(*feeds)
        snr, digital = gains * power, directions * np.sqrt(power)[..., None]
        slope, _, gain = self.response
        radiation = np.matmul(digital[..., None, :], feeds[0])[:, 0, :, 0]
        by_radiation = np.sum(radiation * self.los, axis=2, keepdims=True) * np.conj(self.los)
        by_radiation += self.spatial.scatter(radiation)
        by_radiation *= 2 / self.noise_power_w / (1 + snr[:, 0, :, None])
        gradient = self.board.by_tunings(
            self.ports, tunings[None, None], gain * np.swapaxes(digital, 1, 2),
            np.conj(slope) * by_radiation[:, :, None])
        return float(np.log1p(snr).sum()), gradient[0, 0]

    def rates_after_changes(self, tunings: np.ndarray, levels: np.ndarray) -> np.ndarray:
        """Return the capacities after one element has another of L levels, float64 [N_E, L].

        A change d of a coefficient adds d u to the column of its element, of propagation u, and
        terms of the first and the second order in d to the correlation matrix at the feeds.
        Raises BoardError if elements are coupled.
        """
        slope, offset, gain = self.response
        columns = np.moveaxis(gain * self.board.paths(self.ports)[0], 2, 1)[..., None]
        every = np.repeat(levels[None, :, None], len(tunings), axis=2)
        before, after = (slope * self.board.coefficients(self.ports, one)[0] + offset
                         for one in (tunings[None, None], every))
        configured, scattered, direct = (one[0, 0] for one in self.feeds(tunings))
        matrix = direct * adjoint(direct) + np.matmul(scattered, adjoint(configured))
        los = self.los[0, :, :, None, None]
        first = columns * adjoint(np.swapaxes(scattered, 1, 2)[..., None] + (
            np.conj(los) * direct[:, None]))
        second = columns * adjoint(columns) * (
            self.spatial.power[0, :, None, None] + np.abs(los)**2)
        # Axes: sub-band, level, element, feed, feed.
        change = (after - before)[..., None, None]
        linear = change * first[:, None]
        gains = np.linalg.eigvalsh(
            matrix[:, None, None] + linear + adjoint(linear)
            + np.abs(change)**2 * second[:, None])
        snr = np.moveaxis(np.maximum(gains[..., -1], 0), 0, 2) / self.noise_power_w
        return np.log1p(snr * water_filling(snr, self.power_w)).sum(axis=2).T

    def exchanged(self, tunings: np.ndarray, n_levels: int) -> np.ndarray:
        """Return tunings after exchanges for other levels, until no single one is better.

        Each round makes the exchanges of highest gain together: one, two, four, or more.
        """
        if not n_levels:
            return tunings
        rate = self.best_rate(tunings)[0, 0]
        levels, counts = np.linspace(0, 1, n_levels), 2**np.arange(len(tunings).bit_length())
        for _ in range(_N_EXCHANGES):
            try:
                rates = self.rates_after_changes(tunings, levels)
            except BoardError:
                # With coupling, an element changes the signals of all others.
                others = np.tile(tunings, (len(tunings), n_levels, 1))
                others[np.arange(len(tunings)), :, np.arange(len(tunings))] = levels
                rates = self.best_rate(others.reshape(-1, len(tunings))).reshape(-1, n_levels)
            order = np.argsort(-rates.max(axis=1))
            is_exchanged = np.argsort(order) < counts[:, None]
            together = np.where(is_exchanged, levels[rates.argmax(axis=1)], tunings)
            (rates,) = self.best_rate(together)
            if rates.max() <= rate * (1 + _MIN_GAIN):
                break
            rate, tunings = rates.max(), together[rates.argmax()]
        return tunings
