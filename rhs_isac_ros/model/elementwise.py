"""Boards without coupling: each element has a coefficient of its own."""

import abc
import dataclasses
import functools
from typing import Any, ClassVar

import numpy as np

from rhs_isac_ros.model.arrays import adjoint, numbers, read_only, to_tuples
from rhs_isac_ros.model.board import (
    Board,
    BoardError,
    Factor,
    Ports,
    limited,
    onboard_gain,
    rounded,
)
from rhs_isac_ros.model.constants import NEPERS_PER_DB


@dataclasses.dataclass(frozen=True, eq=False)
class Elementwise(Board):
    """A board without coupling: coefficients of the elements, times propagation to the feeds.

    A subclass defines `coefficients` and `slopes`.
    """

    loss_db_per_m: float = limited(0.0, 0.0, 1e6)  #: Attenuation of the waves on the board.
    #: Amplitude gain of each feed, or None if all are 1.
    feed_gains: tuple[float, ...] | None = limited(None, 0.0, 1e6, is_list=True)
    #: Indices of elements that have no effect, whatever their tuning, as those outside of a disc.
    masked: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Convert and check the fields; raise BoardError if one is invalid."""
        super().__post_init__()
        masked = numbers('masked', self.masked, int, BoardError)
        object.__setattr__(self, 'masked', tuple(sorted({*masked.ravel().tolist()})))

    def implied(self, name: str, scenario: Any) -> Any:
        """Return the gains of feeds."""
        return [1.0] * scenario.n_feeds if name == 'feed_gains' else None

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the board does not fit a scenario, or ''."""
        if self.feed_gains is not None and len(self.feed_gains) != scenario.n_feeds:
            return (f'feed_gains: {len(self.feed_gains)} numbers, expected n_feeds = '
                    f'{scenario.n_feeds}')
        if self.masked and not 0 <= self.masked[0] <= self.masked[-1] < scenario.n_elements:
            return (f'masked: {self.masked[0]} to {self.masked[-1]}, expected 0 to '
                    f'{scenario.n_elements - 1}')
        return super().misfit(scenario)

    @abc.abstractmethod
    def coefficients(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the coefficients of the elements, complex or float [B, 1 or J, Q, N_E]."""

    @abc.abstractmethod
    def slopes(self, ports: Ports, tunings: np.ndarray) -> np.ndarray | float:
        """Return the derivative of `coefficients` by the tunings: as these, [N_E] or a number."""

    @functools.lru_cache(maxsize=64)  # noqa: B019 - boards are few, and equal ones share entries
    def paths(self, ports: Ports) -> np.ndarray:
        """Compute B_{i,j} below Eq. (9) with loss and gains, [B, J, K, N_E], read-only."""
        frequencies, feeds = ports.frequencies_hz[:, :, None, None], ports.feeds_m[:, None, :]
        gains = np.ones(len(feeds)) if self.feed_gains is None else np.array(self.feed_gains)
        distances = np.linalg.norm(ports.elements_m - feeds, axis=-1)
        amplitudes = gains[:, None] * np.exp(-self.loss_db_per_m * NEPERS_PER_DB * distances)
        amplitudes[:, list(self.masked)] = 0.0
        return read_only(amplitudes * onboard_gain(
            ports.refractive_index, frequencies, ports.elements_m, feeds))

    def transfer(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the transfer; see `Board.transfer`."""
        paths = np.swapaxes(self.paths(ports), 2, 3)[:, :, None]
        return self.coefficients(ports, tunings)[..., None] * paths

    def pullback(
            self, ports: Ports, tunings: np.ndarray, by_transfer: np.ndarray) -> np.ndarray:
        """Return the gradient by the tunings; see `Board.pullback`."""
        through = np.einsum('bjqmk,bjkm->bjqm', np.conj(by_transfer), self.paths(ports))
        return np.sum((through * self.slopes(ports, tunings)).real, axis=1)

    def radiation(self, ports: Ports, tunings: np.ndarray, digital: np.ndarray,
                  slope: Factor = 1.0, offset: Factor = 0.0) -> np.ndarray:
        """Weight every element by combining vectors; see `Board.radiation`."""
        applied = slope * self.coefficients(ports, tunings) + offset
        # A beam is a single frame, whose products take less time without matrices.
        weights = (np.matmul(digital, self.paths(ports)) if digital.shape[2] > 1 else
                   np.einsum('bjqk,bjkm->bjqm', digital, self.paths(ports)))
        return applied * weights

    def feeds(self, ports: Ports, tunings: np.ndarray, elements: np.ndarray,
              slope: Factor = 1.0, offset: Factor = 0.0) -> np.ndarray:
        """Compute the signals at the feeds; see `Board.feeds`."""
        applied = slope * self.coefficients(ports, tunings) + offset
        return np.einsum('bjqm,bjkm->bjqk', applied * elements, self.paths(ports))

    def by_tunings(self, ports: Ports, tunings: np.ndarray, digital: np.ndarray,
                   by_radiation: np.ndarray) -> np.ndarray:
        """Pull a gradient back to the tunings; see `Board.by_tunings`."""
        weights = np.matmul(digital, self.paths(ports)) * self.slopes(ports, tunings)
        return np.einsum('ijqm,ijqm->iqm', np.conj(by_radiation), weights).real

    def by_digital(self, ports: Ports, tunings: np.ndarray, by_radiation: np.ndarray,
                   slope: Factor = 1.0, offset: Factor = 0.0) -> np.ndarray:
        """Pull a gradient back to the combining vectors; see `Board.by_digital`."""
        applied = np.conj(slope * self.coefficients(ports, tunings) + offset)
        return np.matmul(by_radiation * applied, adjoint(self.paths(ports)))


@dataclasses.dataclass(frozen=True, eq=False)
class Paper(Elementwise):
    """The board of the paper, Eqs. (5), (6) and (9): the coefficient is the tuning."""

    kind: str = dataclasses.field(default='paper', init=False)
    is_amplitude: ClassVar[bool] = True

    def coefficients(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the tunings as amplitudes, [B, 1, Q, N_E]."""
        return tunings[:, None]

    def slopes(self, ports: Ports, tunings: np.ndarray) -> np.ndarray | float:
        """Return 1."""
        return 1.0

    def focused(self, ports: Ports, los: np.ndarray, n_levels: int = 0) -> np.ndarray:
        """Return tunings by the holographic principle; see `matched_configuration`."""
        return rounded(matched_configuration(los, self.paths(ports)[0]), n_levels)


@dataclasses.dataclass(frozen=True, eq=False)
class PhaseShift(Elementwise):
    """Elements with an adjustable phase: the coefficient is exp(i phase_range_rad c)."""

    kind: str = dataclasses.field(default='phase', init=False)
    #: Phase of the tuning 1, relative to the tuning 0.
    phase_range_rad: float = limited(2 * np.pi, 1e-6, 1e3)

    def coefficients(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return unit phasors, complex128 [B, 1, Q, N_E]."""
        return np.exp(1j * self.phase_range_rad * tunings)[:, None]

    def slopes(self, ports: Ports, tunings: np.ndarray) -> np.ndarray | float:
        """Return the derivative, complex128 [B, 1, Q, N_E]."""
        return 1j * self.phase_range_rad * self.coefficients(ports, tunings)


@dataclasses.dataclass(frozen=True, eq=False)
class Resonant(Elementwise):
    """Elements with an adjustable resonance, of which amplitude and phase change together.

    The coefficient at the frequency f is the polarisability of a Lorentz oscillator relative to
    its maximum, 1 / (1 - i Q (f_0 / f - f / f_0)). Over all f_0, it runs through the circle about
    1/2 with the diameter 1. The tuning c moves the resonance to
    f_0 = f_r (1 + tuning_range (c - 1/2)).

    References
    ----------
    Smith, Yurduseven, Mancera, Bowen and Kundtz, Analysis of a waveguide-fed metasurface antenna,
    Phys. Rev. Applied 8, 2017.
    """

    kind: str = dataclasses.field(default='resonant', init=False)
    #: Resonance f_r of the tuning 1/2 in each band [Hz], or None for the centres of the bands.
    resonances_hz: tuple[float, ...] | None = limited(None, 1e6, 1e13, is_list=True)
    quality_factor: float = limited(40.0, 1.0, 1e6)  #: Quality factor Q of an element.
    tuning_range: float = limited(0.3, 1e-6, 1.9)  #: Range of f_0 relative to f_r.

    def implied(self, name: str, scenario: Any) -> Any:
        """Return the gains of feeds, and the resonances."""
        return (list(scenario.center_frequencies_hz) if name == 'resonances_hz' else
                super().implied(name, scenario))

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the board does not fit a scenario, or ''."""
        if self.resonances_hz is not None and len(self.resonances_hz) != scenario.n_bands:
            return (f'resonances_hz: {len(self.resonances_hz)} numbers, expected one for each of '
                    f'{scenario.n_bands} bands')
        return super().misfit(scenario)

    def coefficients(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the relative polarisabilities, complex128 [B, J, Q, N_E]."""
        return self._curve(self._ratio(ports, tunings))

    def slopes(self, ports: Ports, tunings: np.ndarray) -> np.ndarray | float:
        """Return the derivative, complex128 [B, J, Q, N_E]."""
        ratio = self._ratio(ports, tunings)
        by_ratio = 1j * self.quality_factor * (1 + 1 / ratio**2) * self._curve(ratio)**2
        return by_ratio * (self.tuning_range * self._scale(ports))

    def _curve(self, ratio: np.ndarray) -> np.ndarray:
        return np.asarray(1 / (1 - 1j * self.quality_factor * (ratio - 1 / ratio)))

    def _ratio(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return f_0 relative to the frequency."""
        return self._scale(ports) * (1 + self.tuning_range * (tunings - 0.5))[:, None]

    def _scale(self, ports: Ports) -> np.ndarray:
        """Return f_r relative to the frequency, float64 [B, J, 1, 1]."""
        frequencies = ports.frequencies_hz[..., None, None]
        return (frequencies.mean(axis=1, keepdims=True) if self.resonances_hz is None
                else np.reshape(self.resonances_hz, (-1, 1, 1, 1))[list(ports.bands)]
                ) / frequencies


@dataclasses.dataclass(frozen=True, eq=False)
class States(Elementwise):
    """Elements with a table of states, which need not be equally spaced.

    The tuning of state n of L is n / (L - 1). Between two states, where only a search with
    continuous tunings goes, the coefficient is interpolated linearly. The scenario has as many
    `amplitude_levels` as there are states.
    """

    kind: str = dataclasses.field(default='states', init=False)
    #: Real and imaginary parts of the states: [L, 2] for all bands and elements, [N_B, L, 2], or
    #: [N_B, N_E, L, 2]. Two states off and on, in all bands, unless given.
    states: Any = ((0.0, 0.0), (1.0, 0.0))

    def __post_init__(self) -> None:
        """Convert and check the fields; raise BoardError if one is invalid."""
        super().__post_init__()
        table = numbers('states', self.states, error=BoardError)
        if not 2 <= table.ndim <= 4 or table.shape[-1] != 2 or table.shape[-2] < 2:
            raise BoardError(f'states: shape {table.shape}, expected [L, 2], [N_B, L, 2] or '
                             '[N_B, N_E, L, 2] with at least two states')
        object.__setattr__(self, 'states', to_tuples(table.tolist()))

    @functools.cached_property
    def _table(self) -> np.ndarray:
        """The states as complex128 [L, B or 1, 1, 1, N_E or 1]."""
        table = np.array(self.states) @ [1, 1j]
        table = table.reshape(*[1] * (3 - table.ndim), *table.shape) if table.ndim != 2 else (
            table[:, None])
        return np.moveaxis(table, -1, 0)[:, :, None, None]

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the board does not fit a scenario, or ''."""
        n_states, n_bands, *_, n_elements = self._table.shape
        if scenario.amplitude_levels != n_states:
            return (f'{n_states} states with amplitude_levels = {scenario.amplitude_levels}, '
                    'expected as many levels as states')
        if n_bands not in (1, scenario.n_bands) or n_elements not in (1, scenario.n_elements):
            return (f'states of {n_bands} bands and {n_elements} elements, expected '
                    f'{scenario.n_bands} and {scenario.n_elements}')
        return super().misfit(scenario)

    @property
    def is_affine(self) -> bool:
        """Whether there are only two states, with which the coefficients are affine."""
        return len(self._table) == 2

    def coefficients(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the interpolated states, complex128 [B, 1, Q, N_E]."""
        position = tunings[:, None] * (len(self._table) - 1)
        return np.sum(np.maximum(1 - np.abs(position - self._numbers), 0) * self._states(ports),
                      axis=0)

    def slopes(self, ports: Ports, tunings: np.ndarray) -> np.ndarray | float:
        """Return the differences between neighbouring states, times L - 1."""
        last = len(self._table) - 1
        below = np.clip(np.floor(tunings[:, None] * last), 0, last - 1)
        steps = np.diff(self._states(ports), axis=0) * last
        return np.sum((below == self._numbers[:-1]) * steps, axis=0)

    def _states(self, ports: Ports) -> np.ndarray:
        # A table for all bands has a single row of them.
        return np.take(self._table, ports.bands, axis=1, mode='clip')

    @functools.cached_property
    def _numbers(self) -> np.ndarray:
        return np.arange(len(self._table)).reshape(-1, 1, 1, 1, 1)


def matched_configuration(los: np.ndarray, onboard: np.ndarray) -> np.ndarray:
    """Compute a configuration by the holographic principle, float64 [N_E], entries in [0, 1].

    Takes line-of-sight gains, complex128 [N_SB, N_E], and B_j, complex128 [N_SB, K, N_E]. The
    amplitude of an element is high if the phases of its line-of-sight gain and of its propagation
    on the board cancel. If all gains are 0, all entries are 0.5.
    """
    interference = np.einsum('jm,jkm->m', los, onboard).real
    return (interference / (np.abs(interference).max() or 1.0) + 1) / 2
