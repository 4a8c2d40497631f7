"""Distribution and simulation of the signals received in a positioning phase.

The signals of band i are complex Gaussian with a mean that depends on the user's position and a
covariance Lambda_i that does not. Bands are independent of each other. Errors of the elements add
a covariance, which depends on the position; `impairments` adds unknown gains and phases.

A *state* is a position, [3] [m], or a position and a velocity, [6] [m, m/s]. The position is then
that at the reference time of the cycle, and frame q of band i has the mean of a user who stands
still at p + v t_iq. See `frame_times_s`.
"""

import functools

import numpy as np

from rhs_isac_ros.model import geometry
from rhs_isac_ros.model.arrays import (
    adjoint,
    blocks,
    checked_positions,
    checked_states,
    multiply_rows,
    numbers,
    read_only,
)
from rhs_isac_ros.model.compression import (
    combine_subbands,
    combined_covariance,
    draw_scattered,
    expand_functions,
    is_slow,
    scattered_parts,
    subband_functions,
)
from rhs_isac_ros.model.elements import (
    DeclaredElements,
    DirectErrors,
    ElementErrors,
    SurfaceEstimate,
    SurfaceModel,
    no_direct_errors,
    with_direct_errors,
)
from rhs_isac_ros.model.gaussian import covariance_root
from rhs_isac_ros.model.impairments import draw_impairments, nuisance_of
from rhs_isac_ros.model.los import Waves, boresight_axes, direct_gain, draw_blocked, los_waves
from rhs_isac_ros.model.multipath import (
    complex_normal,
    draw_multipath,
    drawing_root,
    scattered_covariance,
)
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import NOMINAL, Beamforming, combine, radiation_matrix
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread

# Knowledge of the elements of one surface: known errors, or an estimate of the coefficients.
KnownSurface = ElementErrors | SurfaceEstimate
# Number of positions that `simulate_received` processes at a time; affects its random numbers.
_BLOCK = 256
# Target size of arrays over elements and sub-bands [bytes]. Larger arrays do not fit in the cache,
# and every call obtains new memory pages for them. Another size of blocks changes the last digits
# of all results.
_ARRAY_BYTES = 3 << 18
_MIN_BLOCK = 8


def direct_signal(los: np.ndarray, radiation: np.ndarray) -> np.ndarray:
    """Combine line-of-sight gains H^LoS of one band, complex128 [..., N_SB, N_E].

    They are the same in all F frames. Returns the signals without multipath and noise of Eq. (8),
    complex128 [..., N_SB F].
    """
    frames = radiation.reshape(los.shape[-2], -1, radiation.shape[-1])
    # Only the diagonal of H T^T is needed: for each sub-band, its gains times its F rows of T.
    direct = np.matmul(los[..., None, :], np.swapaxes(frames, -1, -2))
    return direct.reshape(*los.shape[:-2], -1)


def received_signal(
        direct: np.ndarray, multipath: np.ndarray | float, radiation: np.ndarray,
        noise: np.ndarray | float, symbol: complex | np.ndarray = 1.0) -> np.ndarray:
    """Implements Eq. (8). Received signals y_i of one band, complex128 [..., N_SB F].

    Parameters
    ----------
    direct
        Signals of the line of sight, complex128 [..., N_SB F]; see `direct_signal`.
    multipath
        Multipath gains H^MP, complex128 [..., N_SB F, N_E] (sub-band-major), or 0.
    radiation
        T_i, complex128 [N_SB F, N_E].
    noise
        Thermal noise e, complex128 [..., N_SB F], or 0.
    symbol
        The user's symbol x, or one for each measurement, complex128 [..., N_SB F].
    """
    if np.ndim(multipath):
        direct = direct + np.einsum('...rm,rm->...r', multipath, radiation)
    return direct * symbol + noise


@one_blas_thread
def simulate_received(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
        rng: np.random.Generator, surface: ElementErrors | None = None) -> np.ndarray:
    """Simulate the signals of independent positioning phases by Eq. (8), element by element.

    The user's position in each phase is a row of `positions`, float64 [N, 3] [m]; with columns for
    the velocity, [N, 6], the user moves. Returns complex128 [N, N_B, N_SB F], sub-band-major.
    Declared impairments are drawn too: a new user and a new cycle for each position, and one
    surface for all positions unless `surface` is given. So are declared velocities that are not
    given. With a channel file, the nearest user of the file replaces each position. Raises
    ValueError if `positions` is not a finite array [N, 3] or [N, 6], or a size differs from the
    scenario's.

    Examples
    --------
    >>> users, rng = np.array([[8.0, 1.0, 0.2], [12.0, -2.0, 0.5]]), np.random.default_rng(1)
    >>> simulate_received(Scenario(), Codebook.default(), users, rng).shape
    (2, 2, 32)
    """
    states = _moving(scenario, positions, rng)
    drawn, factors = draw_impairments(scenario, len(states), rng)
    blocked = draw_blocked(scenario, len(states), rng)
    surface = surface or drawn
    radiation = radiation_matrix(scenario, codebook, surface.response if surface else NOMINAL)
    n_bands, n_measurements, _ = radiation.shape
    received = np.empty((len(states), n_bands, n_measurements), complex)
    # Gains of all elements in many sub-bands take too much memory.
    is_large = subband_functions(scenario) is not None
    parts = scattered_parts(scenario, radiation) if is_large and not scenario.channel else []
    for block in blocks(len(states), _MIN_BLOCK if is_large else _BLOCK):
        for band in range(n_bands):
            direct = _direct(scenario, states[block], band, blocked[block], radiation[band])
            gains: np.ndarray | float = 0.0
            scattered: np.ndarray | float = 0.0
            if parts:
                scattered = draw_scattered(scenario, parts[band], len(direct), rng)
            elif not scenario.channel:
                gains = draw_multipath(scenario, band, len(direct), rng)
            noise = _thermal_noise(scenario, direct.shape, rng)
            symbol = 1.0 if factors is None else factors[block, band]
            received[block, band] = received_signal(
                direct, gains, radiation[band], noise + scattered * symbol, symbol)
    return received


def _moving(scenario: Scenario, states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Check states, and draw the declared velocities of positions."""
    states, std = checked_states(states), geometry.velocity_std_mps(scenario)
    if states.shape[1] > 3 or not std.any():
        return states
    return np.hstack([states, std * rng.standard_normal(states.shape)])


def _direct(scenario: Scenario, states: np.ndarray, band: int, blocked: np.ndarray,
            radiation: np.ndarray) -> np.ndarray:
    """Compute the signals of the direct paths of a band, complex128 [N, N_SB F]."""
    if states.shape[1] == 3:
        return direct_signal(direct_gain(scenario, states, band, blocked), radiation)
    frames = radiation.reshape(scenario.n_subbands, scenario.n_frames, -1)
    signals = np.empty((len(states), *frames.shape[:2]), complex)
    for frame, time_s in enumerate(geometry.frame_times_s(scenario)[band].tolist()):
        signals[:, :, frame] = direct_signal(direct_gain(
            scenario, states[:, :3], band, blocked, time_s * states[:, 3:]), frames[:, frame])
    return signals.reshape(len(states), -1)


def receive_feeds(
        scenario: Scenario, codebook: Beamforming, feeds: np.ndarray,
        rng: np.random.Generator | None) -> np.ndarray:
    """Combine the feed signals of a positioning phase by Eq. (7), complex128 [N_B, N_SB, F].

    `feeds` are the signals at the feeds, complex128 [N_B, F, N_SB, K]. `rng` draws the thermal
    noise; it is None if the signals already contain noise.
    """
    noise = 0.0 if rng is None else _thermal_noise(scenario, codebook.digital.shape[:3], rng)
    return combine(codebook.digital, np.swapaxes(feeds, 1, 2), noise)


def _thermal_noise(
        scenario: Scenario, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    return np.sqrt(scenario.noise_power_w) * complex_normal(shape, rng)


def signal_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Implements Eq. (14). Covariance of the received signals, independent of the position.

    Returns Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W], for the radiation matrices T_i of all
    bands, complex128 [N_B, N_SB F, N_E].
    """
    noise = scenario.noise_power_w * np.eye(radiation.shape[1])
    return scattered_covariance(scenario, radiation) + noise


class MeasurementModel:
    """Distribution of the received signals for one scenario and beamforming.

    Instances are immutable. The constructor computes only the radiation matrices; `prepare` or the
    first use computes the factors of the covariance and the weights of the mean signals.

    Methods that take positions of the user, float64 [N, 3] [m], raise ValueError if the shape is
    wrong or a value is not finite. `mean`, `mean_and_jacobian` and `sample` also take states with
    velocities, float64 [N, 6] [m, m/s]. Measurements are sub-band-major. Only `sample` includes
    impairments, blocked users, channel files and declared velocities. The constructor raises
    ValueError if the beamforming or the surface does not have the sizes of the scenario.

    Parameters
    ----------
    surface
        Known errors of the elements, or an estimate of the elements; the covariance then includes
        the errors of the estimate. By default, the errors of the elements are unknown and have the
        declared distribution: the mean is an average over surfaces, and the covariance includes
        the errors.

    Examples
    --------
    >>> model = MeasurementModel(Scenario(), Codebook.default())
    >>> model.mean(np.array([[8.0, 1.0, 0.2]])).shape  # [N, N_B, N_SB F]
    (1, 2, 32)
    """

    @one_blas_thread
    def __init__(self, scenario: Scenario, beamforming: Beamforming,
                 surface: KnownSurface | None = None) -> None:
        self.scenario, self.beams, self.surface = scenario, beamforming, surface
        self.elements: SurfaceModel = surface or DeclaredElements(scenario)
        #: T_i of Eq. (9) for the coefficients in effect, complex128 [N_B, N_SB F, N_E].
        self.radiation = read_only(
            radiation_matrix(scenario, beamforming, self.elements.response))

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes (N_B, N_SB F) of the signals of a positioning phase."""
        n_bands, n_measurements, _ = self.radiation.shape
        return n_bands, n_measurements

    @one_blas_thread
    def covariance(self) -> np.ndarray:
        """Compute Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W]; the result is not cached.

        Unknown errors of the elements contribute their average over the region of interest.
        """
        covariance = signal_covariance(self.scenario, self.radiation)
        if not self.elements.is_exact:
            covariance += self.elements.error_covariance(self.scenario, self.beams)
        return covariance

    def covariance_at(self, positions: np.ndarray) -> np.ndarray:
        """Compute the covariance at positions, complex128 [N, N_B, N_SB F, N_SB F] [W].

        It depends on the position only if errors of the elements are unknown.
        """
        return with_direct_errors(*self._constant, checked_positions(positions))

    def covariance_in_shadow(self, scenario: Scenario | None = None) -> np.ndarray:
        """Return the covariance without a direct path, complex128 [N_B, N_SB F, N_SB F] [W].

        `scenario` may have other fields of the multipath than that of the model. They do not
        change the radiation matrices, which take much of the time of a model.
        """
        return (self._constant_of(scenario) if scenario else self._constant)[0]

    @functools.cached_property
    def _constant(self) -> tuple[np.ndarray, DirectErrors]:
        """The part of `covariance_at` that is the same everywhere, and errors of the rest."""
        return self._constant_of(self.scenario)

    def _constant_of(self, scenario: Scenario) -> tuple[np.ndarray, DirectErrors]:
        covariance = signal_covariance(scenario, self.radiation)
        if self.elements.is_exact:
            return covariance, functools.partial(no_direct_errors, self.shape[1])
        elements = self.surface or DeclaredElements(scenario)
        scattered, direct = elements.errors(scenario, self.beams)
        return covariance + scattered, direct

    @functools.cached_property
    def _functions(self) -> np.ndarray | None:
        """Functions of the sub-bands, or None if there are not many; see `compression`."""
        functions = subband_functions(self.scenario) if self.elements.is_exact else None
        if functions is None or not is_slow(functions, self.radiation):
            return None
        return functions

    @functools.cached_property
    def combined_root(self) -> np.ndarray:
        """The same factor of the covariance of signals after `combine`, [N_B, n, n], read-only."""
        covariance = self.covariance() if self._functions is None else combined_covariance(
            self.scenario, self.radiation, self._functions)
        return read_only(covariance_root(
            self.scenario, covariance, orthogonal=nuisance_of(self.scenario).has_gain))

    @functools.cached_property
    def combined_whitener(self) -> np.ndarray:
        """Inverse of `combined_root`, complex128 [N_B, n, n], read-only."""
        return read_only(np.linalg.inv(self.combined_root))

    @functools.cached_property
    def root(self) -> np.ndarray:
        """Factor L_i with L_i L_i^H = Lambda_i, complex128 [N_B, N_SB F, n].

        It is the Cholesky factor. With an unknown gain, which does not act on the noise, its
        columns are orthogonal instead. The number n is N_SB F, or less for many sub-bands, whose
        signals are combined first; L_i L_i^H is then the covariance of the combined signals.
        """
        return read_only(self.expand(self.combined_root))

    @functools.cached_property
    def whitener(self) -> np.ndarray:
        """Inverse of `root`, complex128 [N_B, n, N_SB F]."""
        return read_only(adjoint(self.expand(adjoint(self.combined_whitener))))

    @property
    def n_whitened(self) -> int:
        """Number of whitened signals of all bands."""
        return int(np.prod(self.combined_root.shape[:2]))

    @one_blas_thread
    def prepare(self) -> 'MeasurementModel':
        """Compute what later calls need, and return the model."""
        _ = self.combined_whitener, self._weights
        return self

    def expand(self, matrices: np.ndarray) -> np.ndarray:
        """Apply the adjoint of `combine` to matrices [N_B, n, m]; return [N_B, N_SB F, m]."""
        return expand_functions(self._functions, matrices)

    def combine(self, signals: np.ndarray) -> np.ndarray:
        """Combine many sub-bands of signals [..., N_B, N_SB F] to [..., N_B, n]."""
        return combine_subbands(self._functions, signals)

    def whiten(self, signals: np.ndarray) -> np.ndarray:
        """Transform signals [..., N_B, N_SB F] to unit covariance, [..., N_B, n].

        Raises ValueError for anything but numbers of this shape.
        """
        signals = numbers(
            'signals', signals, complex, shapes=[('...', *self.shape)], finite=False)
        return multiply_rows(self.combined_whitener, self.combine(signals))

    def mean(self, positions: np.ndarray) -> np.ndarray:
        """Compute the mean signals, complex128 [N, N_B, N_SB F]: Eq. (8) for the direct path."""
        states = checked_states(positions)
        return self.mean_and_jacobian(states, np.zeros((*states.shape, 0)))[0]

    def mean_and_jacobian(
            self, positions: np.ndarray, by_coordinate: np.ndarray | None = None, *,
            whitened: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mean and its derivative, complex128 [N, D, N_B, N_SB F] [1/m]: Eq. (13).

        D is 3, or 6 with velocities, whose columns are in s/m. With `whitened`, both results are
        whitened. `by_coordinate`, float64 [N, D, Q], contains derivatives of the states with
        respect to Q other coordinates; the derivative of the mean, [N, Q, N_B, N_SB F], is then
        with respect to these coordinates.
        """
        states, weights = checked_states(positions), self._weights
        n, (n_bands, n_rows), moving = len(states), self.shape, states.shape[1] > 3
        if by_coordinate is None:
            by_coordinate = np.broadcast_to(np.eye(states.shape[1]), (n, *states.shape[1:] * 2))
        n_slopes = by_coordinate.shape[2]
        n_rows = self.combined_whitener.shape[1] if whitened else n_rows
        mean = np.empty((n, n_bands, n_rows), complex)
        jacobian = np.empty((n, n_slopes, n_bands, n_rows), complex)
        by_term = np.zeros((n, 0, 0)) if moving else np.matmul(
            np.swapaxes(by_coordinate, 1, 2), weights.weights(states))

        def fill(block: slice) -> None:
            terms = (weights.moving(states[block], by_coordinate[block]) if moving
                     else weights.terms(states[block], n_slopes > 0))
            if whitened:
                terms = self._whitened_terms(terms)
            mean[block] = np.swapaxes(terms[:, :, 0], 0, 1)
            if not n_slopes:
                return
            parts = terms[:, :, 1:] if moving else np.matmul(
                by_term[block], terms[:, :, 1:].view(float)).view(complex)
            jacobian[block] = np.moveaxis(parts, 0, 2)

        map_blocks(fill, blocks(n, weights.block))
        return mean, jacobian

    @one_blas_thread
    def sample(self, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw signals of independent phases, one at each position, complex128 [N, N_B, N_SB F].

        The signals have the same distribution as in `simulate_received`, including declared
        impairments and channel files. The multipath is drawn from the covariance of its signals,
        which is a hundred times as fast as drawing the gain of every element.
        """
        scenario, states = self.scenario, _moving(self.scenario, positions, rng)
        surface, factors = draw_impairments(scenario, len(states), rng)
        blocked = draw_blocked(scenario, len(states), rng)
        model = self
        if surface is not None and self.surface is None:
            model = MeasurementModel(scenario, self.beams, surface)
        if scenario.channel:
            signals = np.empty((len(states), *self.shape), complex)

            def fill(block: slice) -> None:
                for band, radiation in enumerate(model.radiation):
                    signals[block, band] = _direct(
                        scenario, states[block], band, blocked[block], radiation)

            map_blocks(fill, blocks(len(states), self._weights.block))
        else:
            signals = model.mean(states)
            signals[blocked] = 0
            if subband_functions(scenario) is not None:
                for band, parts in enumerate(model._parts):
                    signals[:, band] += draw_scattered(scenario, parts, len(states), rng)
            else:
                white = complex_normal(signals.shape, rng)
                # Factors act on the multipath, but not on the noise.
                roots = model.combined_root if factors is None else map(
                    drawing_root, scattered_covariance(scenario, model.radiation))
                for band, root in enumerate(roots):
                    signals[:, band] += white[:, band, :root.shape[1]] @ root.T
                if factors is None:
                    return signals
        noise = _thermal_noise(scenario, signals.shape, rng)
        return signals * (1.0 if factors is None else factors) + noise

    def _whitened_terms(self, terms: np.ndarray) -> np.ndarray:
        """Whiten the result of `ElementSums.terms`."""
        flat = combine_subbands(self._functions, terms.reshape(len(terms), -1, terms.shape[-1]))
        white = np.matmul(flat, np.swapaxes(self.combined_whitener, 1, 2))
        return white.reshape(*terms.shape[:-1], -1)

    @functools.cached_property
    def _parts(self) -> list[np.ndarray]:
        return scattered_parts(self.scenario, self.radiation)

    @functools.cached_property
    def _weights(self) -> 'ElementSums':
        return ElementSums(self.scenario, self.radiation)


class ElementSums:
    """Implements Eq. (13). Sums over the elements for the mean signals and their derivative.

    The sum of a_m T_m (p - p_m) over elements m, with factors a_m, is computed as p times the sum
    of a_m T_m, minus the sum of a_m T_m p_m. This avoids an array of N_E by 3. `block` is the
    number of positions to evaluate at a time.
    """

    def __init__(self, scenario: Scenario, radiation: np.ndarray) -> None:
        self._scenario = scenario
        shape = scenario.n_bands, scenario.n_subbands, scenario.n_frames, scenario.n_elements
        self.block = max(_ARRAY_BYTES // (16 * shape[1] * shape[3]), _MIN_BLOCK)
        self._boresight_axes = boresight_axes(scenario)
        # T_i divided by the frequency, complex128 [N_B, N_SB, N_E, F].
        self._frames = np.ascontiguousarray(
            np.swapaxes(radiation.reshape(shape), 2, 3)
            / geometry.subband_frequencies_hz(scenario)[..., None, None])
        self._elements = geometry.element_positions(scenario)
        # The A axes along which elements are not at 0.
        self._axes = np.flatnonzero(self._elements.any(axis=0))
        self._n_sums = len(self._axes) + len(self._boresight_axes)
        coordinates = np.hstack([np.ones((shape[3], 1)), self._elements[:, self._axes]])
        moments = coordinates[:, :, None] * self._frames[..., None, :]
        # `_frames` times 1 and A coordinates [m], complex128 [N_B, N_SB, N_E, (1 + A) F].
        self._moments = moments.reshape(*self._frames.shape[:3], -1)

    def terms(self, positions: np.ndarray, slopes: bool = True) -> np.ndarray:
        """Compute the mean and the terms of its derivative, complex128 [N_B, N, 1 + G, N_SB F].

        Row 0 is the mean. The other G rows, for the result of `weights`, exist only with `slopes`.
        """
        n, (n_bands, n_subbands, _, n_frames) = len(positions), self._frames.shape
        n_terms = 2 + self._n_sums if slopes else 1
        terms = np.empty((n_bands, n, n_terms, n_subbands, n_frames), complex)
        waves = los_waves(self._scenario, positions, range(n_bands), slopes=slopes)
        self._add_up(waves, self._frames, self._moments, terms)
        return terms.reshape(n_bands, n, n_terms, -1)

    def moving(self, states: np.ndarray, by_coordinate: np.ndarray) -> np.ndarray:
        """Compute mean and derivatives for states with velocities, [N_B, N, 1 + Q, N_SB F].

        `by_coordinate`, float64 [N, 6, Q], is that of `MeasurementModel.mean_and_jacobian`.
        """
        n, (n_bands, n_subbands, n_elements, n_frames) = len(states), self._frames.shape
        n_slopes = by_coordinate.shape[2]
        varies = bool(by_coordinate.any())
        n_terms = 2 + self._n_sums if varies else 1
        rows = np.zeros((n_bands, n, 1 + n_slopes, n_subbands, n_frames), complex)
        # Users at rest are at one place in all frames. Otherwise, each frame has its own place. In
        # the sums, places take the part of the bands.
        moves = bool(states[:, 3:].any())
        frames, moments = self._of_frames if moves else (
            self._frames[:, None], self._moments[:, None])
        for band, times_s in enumerate(geometry.frame_times_s(self._scenario)):
            for part in blocks(frames.shape[1], max(self.block // n, 1)):
                of_place, same = frames[band, part], part if moves else slice(None)
                times = times_s[same, None, None]
                places = states[:, :3] + times[:len(of_place)] * states[:, 3:]
                waves = los_waves(
                    self._scenario, places.reshape(-1, 3), [band], slopes=varies)
                shape = n_subbands, len(places), n, n_elements
                gain, radial, *others = (one.reshape(shape).swapaxes(0, 1) for one in (
                    *waves[:2], *waves[2]))
                terms = np.empty((len(places), n, n_terms, n_subbands, frames.shape[-1]), complex)
                self._add_up(
                    (gain, radial, others), of_place, moments[band, part], terms)
                rows[band, :, 0, :, same] = np.moveaxis(terms[:, :, 0], 0, 2).reshape(
                    n, n_subbands, -1)
                if varies:
                    by_place = by_coordinate[:, :3] + times[..., None] * by_coordinate[:, 3:]
                    weights = self.weights(places.reshape(-1, 3)).reshape(
                        len(places), n, 3, -1)
                    by_term = np.matmul(np.swapaxes(by_place, 2, 3), weights)
                    of_frame = np.ascontiguousarray(np.moveaxis(terms[:, :, 1:], 4, 1).reshape(
                        len(times), n, n_terms - 1, n_subbands)).view(float)
                    rows[band, :, 1:, :, same] = np.moveaxis(
                        np.matmul(by_term, of_frame).view(complex), 0, 3)
        return rows.reshape(n_bands, n, 1 + n_slopes, -1)

    @functools.cached_property
    def _of_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Those of `_frames` and `_moments` of each frame, [N_B, F, N_SB, N_E, 1 or 1 + A]."""
        n_frames = self._frames.shape[3]
        moments = self._moments.reshape(*self._frames.shape[:3], -1, n_frames)
        return (np.ascontiguousarray(np.moveaxis(self._frames[..., None], 3, 1)),
                np.ascontiguousarray(np.moveaxis(moments, 4, 1)))

    def _add_up(self, waves: Waves, frames: np.ndarray, moments: np.ndarray, terms: np.ndarray
                ) -> None:
        """Write sums for frames of B bands or places to `terms`, [B, N, 1 + G, N_SB, F]."""
        gain, radial, boresight_terms = waves
        rows = terms.transpose(0, 3, 1, 2, 4)
        rows[..., 0, :] = np.matmul(gain, frames)
        if terms.shape[2] == 1:
            return
        sums = np.matmul(radial, moments)
        rows[..., 1:2 + len(self._axes), :] = sums.reshape(
            *gain.shape[:-1], -1, frames.shape[-1])
        for number, term in enumerate(boresight_terms, 2 + len(self._axes)):
            rows[..., number, :] = np.matmul(term, frames)

    def weights(self, positions: np.ndarray) -> np.ndarray:
        """Compute the weights of the terms for each coordinate's derivative, float64 [N, 3, G]."""
        weights = np.zeros((len(positions), 3, 1 + self._n_sums))
        weights[:, :, 0] = positions
        weights[:, self._axes, 1 + np.arange(len(self._axes))] = -1
        for number, axis in enumerate(self._boresight_axes, 1 + len(self._axes)):
            weights[:, axis, number] = 1
        return weights
