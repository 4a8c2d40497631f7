"""A board with coupled elements: a network whose ports are the feeds and the elements.

A simulation, a measurement or `waveguides` provides the admittances Y of the network. Each element
is loaded with an admittance that depends on its tuning. The transfer is

    (diag(load) + Y_ss)^-1 Y_st,

where s stands for the ports of the elements and t for those of the feeds.
"""

import dataclasses
import functools
import hashlib
import itertools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import adjoint, digest, evenly_spread, numbers
from rhs_isac_ros.model.board import Board, BoardError, Ports, limited
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import ArchiveError, read_arrays, read_once
from rhs_isac_ros.support.optional import optional_import

# Relative tolerance of reciprocity and passivity, which simulations meet only approximately.
_TOLERANCE = 1e-4
# Largest step between frequencies of the file, relative to the frequency, to interpolate in it.
_MAX_STEP = 0.02
# Largest relative error of an interpolated transfer.
_MAX_ERROR = 0.03
# Relative difference of frequencies that count as equal: files may state them with six digits.
_ROUNDING = 5e-6
# A comment in a Touchstone file.
_COMMENT = re.compile(r'!.*')
_LOADS = 'load_conductance_s', 'load_susceptance_slope_s'


class Admittances(NamedTuple):
    """Admittances [S] of a network without its loads, at ascending frequencies."""

    frequencies_hz: np.ndarray  # float64 [P].
    feeds: np.ndarray  # Y_tt, complex128 [P, K, K].
    between: np.ndarray  # Y_st, complex128 [P, N_E, K].
    elements: np.ndarray  # Y_ss, complex128 [P, N_E, N_E].
    # Conductance of the loads, and the change of their susceptance over the range of the tuning,
    # float64 [N_E] or a number; NaN if the file has none.
    conductance_s: np.ndarray
    susceptance_slope_s: np.ndarray
    digest: str

    @classmethod
    @read_once
    def load(cls, path: str | Path) -> 'Admittances':
        """Read an archive of NumPy's format ``.npz``; raise BoardError if it is invalid."""
        with translated(ArchiveError, BoardError):
            arrays = read_arrays(path)
        with translated(ValueError, BoardError, path):
            return cls.of(arrays)

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> 'Admittances':
        """Convert and check the arrays of a file, [P, ...] or those of a single frequency.

        Raises ValueError, mostly BoardError, if an array is missing or has another shape, or the
        network is not reciprocal and passive.
        """
        if missing := {'frequency_hz', 'y_tt', 'y_st', 'y_ss'} - content.keys():
            raise BoardError(f'no {", ".join(sorted(missing))}, expected the admittances of '
                             'a network')
        frequencies = np.atleast_1d(numbers('frequency_hz', content['frequency_hz']))
        n, arrays = len(frequencies), []
        if frequencies.ndim != 1 or not (np.diff(frequencies, prepend=0) > 0).all():
            raise BoardError(f'frequency_hz: {frequencies}, expected ascending ones above 0')
        for name in ('y_tt', 'y_st', 'y_ss'):
            array = numbers(name, content[name], complex)
            arrays.append(array[None] if array.ndim == 2 else array)
        n_elements, n_feeds = (*arrays[1].shape, 0, 0)[1:3]
        for name, array, sizes in zip(('y_tt', 'y_st', 'y_ss'), arrays, (
                (n_feeds, n_feeds), (n_elements, n_feeds), (n_elements, n_elements)), strict=True):
            if array.shape != (n, *sizes) or 0 in array.shape:
                raise BoardError(f'{name}: shape {array.shape}, expected {(n, *sizes)} for '
                                 f'{n} frequencies, {n_elements} elements and {n_feeds} feeds')
        conductance, slope = loads = [
            numbers(name, content.get(name, np.nan), shapes=[(), (n_elements,)], finite=False)
            for name in _LOADS]
        feeds, between, elements = arrays
        network = cls(frequencies, feeds, between, elements, conductance, slope,
                      digest(frequencies, *arrays, *loads))
        network._check()
        return network

    def _check(self) -> None:
        """Raise BoardError unless the network is reciprocal and passive."""
        across = np.concatenate([self.feeds, np.swapaxes(self.between, 1, 2)], axis=2)
        whole = np.concatenate([
            across, np.concatenate([self.between, self.elements], axis=2)], axis=1)
        sizes = np.abs(whole).max(axis=(1, 2))
        errors = np.abs(whole - np.swapaxes(whole, 1, 2)).max(axis=(1, 2)) / sizes
        if errors.max() > _TOLERANCE:
            raise BoardError(
                f'not reciprocal at {self.frequencies_hz[errors.argmax()]:g} Hz: Y and its '
                f'transpose differ by {errors.max():.2g} of the largest admittance, expected at '
                f'most {_TOLERANCE:g}')
        gains = -np.linalg.eigvalsh((whole + adjoint(whole)) / 2)[:, 0] / sizes
        if gains.max() > _TOLERANCE:
            raise BoardError(
                f'not passive at {self.frequencies_hz[gains.argmax()]:g} Hz: the least eigenvalue '
                f'of the conductance is {-gains.max():.2g} of the largest admittance, expected at '
                f'least {-_TOLERANCE:g}')


def read_touchstone(path: str | Path, n_feeds: int) -> dict[str, np.ndarray]:
    """Read a Touchstone file with the ports of the feeds, and then those of the elements.

    Returns arrays of a file of this module, without the loads. Raises BoardError if the file
    cannot be read, or its meaning is uncertain, and MissingLibraryError without scikit-rf.
    """
    with optional_import('Touchstone', extra='touchstone'):
        import skrf
    try:
        lines = [_COMMENT.sub('', line).strip().lower()
                 for line in Path(path).read_text(encoding='utf-8', errors='replace').splitlines()]
        _check_dialect(lines)
        network = skrf.Network(str(path))
        admittances = numbers('Y', network.y, complex)
    # The library raises various exceptions for malformed files.
    except Exception as error:
        raise BoardError(f'{path}: cannot be read: {error}') from error
    n_ports = admittances.shape[1]
    if not 0 < n_feeds < n_ports:
        raise BoardError(f'{path}: {n_ports} ports with {n_feeds} feeds, expected more ports than '
                         'feeds')
    return {'frequency_hz': np.array(network.f), 'y_tt': admittances[:, :n_feeds, :n_feeds],
            'y_st': admittances[:, n_feeds:, :n_feeds], 'y_ss': admittances[:, n_feeds:, n_feeds:]}


def _check_dialect(lines: list[str]) -> None:
    """Raise BoardError for files that scikit-rf 2.2.0 misreads without an error."""
    options = next((line[1:].split() for line in lines if line.startswith('#')), [])
    version = next((line for line in lines if line.startswith('[version]')), '')
    kind = next((option for option in options if option in ('s', 'y', 'z', 'h', 'g')), 's')
    if not version and kind not in ('s', 'z'):
        raise BoardError(f'parameter {kind.upper()} of version 1, expected S or Z, or version 2: '
                         'the normalisation is ambiguous')
    formats = [line for line in lines if line.startswith('[matrix format]')]
    if any('full' not in line for line in formats):
        raise BoardError('a lower or upper matrix, expected full matrices')


@dataclasses.dataclass(frozen=True, eq=False)
class CoupledNetwork(Board):
    """A board of coupled elements, from a file of admittances.

    The load of an element with the tuning c is

        conductance - i Im(Y_mm) + i susceptance_slope (c - 1/2),

    where Y_mm is its own admittance, so that a single element resonates at the tuning 1/2. Between
    frequencies of the file, the transfer is interpolated linearly.
    """

    kind: str = dataclasses.field(default='network', init=False)
    file: str = ''  #: Path of the file, which may be followed by ``@`` and the digest.
    gain: float = limited(1.0, 1e-12, 1e12)  #: Factor of the transfer.
    #: Conductance of a load, and slope as in the formula, or None as in the file.
    load_conductance_s: float | None = limited(None, 0.0, 1e12)
    load_susceptance_slope_s: float | None = limited(None, 0.0, 1e12)

    def __post_init__(self) -> None:
        """Read the file; raise BoardError if it or a number is invalid."""
        super().__post_init__()
        if not isinstance(self.file, str | Path) or not str(self.file):
            raise BoardError(f'file: {self.file!r}, expected the path of a file of admittances')
        path, expected = re.fullmatch(  # type: ignore[union-attr]
            r'(.*?)(?:@([0-9a-f]{16}))?', str(self.file), re.DOTALL).groups()
        with translated(BoardError, BoardError, 'file'):
            network = Admittances.load(path)
        if expected not in (None, network.digest):
            raise BoardError(f'file: {path}: digest {network.digest}, expected {expected}: the '
                             'content has changed')
        object.__setattr__(self, 'file', f'{path}@{network.digest}')
        for name, own in zip(
                _LOADS, (network.conductance_s, network.susceptance_slope_s), strict=True):
            if getattr(self, name) is None and np.isnan(own).any():
                raise BoardError(f'{name}: None, expected a number, as {path} has none')

    @functools.cached_property
    def network(self) -> Admittances:
        """The admittances without the loads."""
        network: Admittances = Admittances.load(self.file.rpartition('@')[0])
        conductance, slope = self.load_conductance_s, self.load_susceptance_slope_s
        return network._replace(
            conductance_s=network.conductance_s if conductance is None else np.array(conductance),
            susceptance_slope_s=network.susceptance_slope_s if slope is None else np.array(slope))

    @functools.cached_property
    def id(self) -> str:
        """Hash of the fields and of the content of the file."""
        fields = self.network.digest, self.gain, self.load_conductance_s, (
            self.load_susceptance_slope_s)
        return hashlib.sha256(repr(fields).encode()).hexdigest()[:16]

    def implied(self, name: str, scenario: Any) -> Any:
        """Return the number of the file, unless its elements have different ones."""
        network = self.network
        load = dict(zip(_LOADS, (network.conductance_s, network.susceptance_slope_s),
                        strict=True)).get(name, np.ones(0))
        return None if load.ndim else load.item()

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the board does not fit a scenario, or ''."""
        n_elements, n_feeds = self.network.between.shape[1:]
        if (n_elements, n_feeds) != (scenario.n_elements, scenario.n_feeds):
            return (f'{self.file}: {n_elements} elements and {n_feeds} feeds, expected '
                    f'{scenario.n_elements} and {scenario.n_feeds}')
        span = (np.arange(scenario.n_subbands) - (scenario.n_subbands - 1) / 2) * (
            scenario.spacing_hz)
        with_bands = np.add.outer(scenario.center_frequencies_hz, span)
        try:
            for band in with_bands:
                self._check_steps(band)
        except BoardError as error:
            return f'{self.file}: {error}'
        return super().misfit(scenario)

    def transfer(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the transfer; see `Board.transfer`."""
        return np.stack([
            np.tensordot(weights, self._solved(points, frames)[1], axes=1)
            for (points, weights), frames in zip(self._points(ports), tunings, strict=True)])

    def pullback(
            self, ports: Ports, tunings: np.ndarray, by_transfer: np.ndarray) -> np.ndarray:
        """Return the gradient by the tunings; see `Board.pullback`."""
        from scipy.linalg import lu_solve

        gradients = np.zeros(tunings.shape)
        for band, (points, weights) in enumerate(self._points(ports)):
            factors, transfers = self._solved(points, tunings[band])
            # Y is symmetric, so the adjoint of its inverse is the conjugate.
            by_point = np.conj(np.tensordot(weights.T, by_transfer[band], axes=1))
            for point, frame in np.ndindex(transfers.shape[:2]):
                through = lu_solve(factors[point][frame], by_point[point, frame] * self.gain,
                                   check_finite=False)
                gradients[band, frame] += np.sum(
                    through * transfers[point, frame], axis=1).imag / self.gain
        return gradients * self.network.susceptance_slope_s

    def _check_steps(self, wanted_hz: np.ndarray) -> None:
        """Raise BoardError unless transfers are accurate that are interpolated in a band."""
        network = self.network
        # They stand for those of a codebook.
        tunings = evenly_spread(network.between.shape[1])[None]
        points, weights = _between(network.frequencies_hz, wanted_hz)
        for first, ends in enumerate(itertools.pairwise(points)):
            # The middle has the largest error.
            shares = weights[:, first:first + 2]
            share = shares[shares.prod(axis=1).argmax()]
            if not share.all():
                continue
            transfer = np.tensordot(share, self._solved(ends, tunings)[1], axes=1)
            elements, between = (np.tensordot(share, array[[*ends]], axes=1) for array in (
                network.elements, network.between))
            other = self.gain * _loaded(network, elements, between, tunings)[1]
            # Interpolated admittances have errors of about the same size and of their own.
            error, size = 2 * np.linalg.norm(other - transfer), np.linalg.norm(transfer)
            if error > _MAX_ERROR * size:
                low, high = network.frequencies_hz[[*ends]]
                raise BoardError(
                    f'a transfer between {low:.9g} Hz and {high:.9g} Hz would have an error of '
                    f'about {100 * error / size:.2g} %, expected at most {100 * _MAX_ERROR:g} %, '
                    'as with smaller steps')

    @functools.lru_cache(maxsize=64)  # noqa: B019 - boards are few, and equal ones share entries
    def _points(self, ports: Ports) -> list[tuple[tuple[int, ...], np.ndarray]]:
        """Return frequencies of the file for each band, and weights of each sub-band for them."""
        return [_between(self.network.frequencies_hz, band) for band in ports.frequencies_hz]

    def _solved(self, points: tuple[int, ...], tunings: np.ndarray) -> tuple[Any, np.ndarray]:
        """Return factors of the loaded network, and the transfer, [P, Q, N_E, K]."""
        return _solved(self, points, tunings.shape, np.ascontiguousarray(tunings).tobytes())


# A gradient needs the factors that the signals needed, for each band.
@functools.lru_cache(maxsize=8)
def _solved(board: CoupledNetwork, points: tuple[int, ...], shape: tuple[int, ...], tunings: bytes
            ) -> tuple[Any, np.ndarray]:
    network, frames = board.network, np.frombuffer(tunings).reshape(shape)
    transfers = np.empty((len(points), len(frames), *network.between.shape[1:]), complex)
    factors: list[list[Any]] = []
    for row, point in enumerate(points):
        found, transfers[row] = _loaded(
            network, network.elements[point], network.between[point], frames)
        factors.append(found)
    return factors, board.gain * transfers


def _loaded(network: Admittances, elements: np.ndarray, between: np.ndarray, frames: np.ndarray
            ) -> tuple[list[Any], np.ndarray]:
    """Return factors of admittances with the loads of frames, and the transfers [Q, N_E, K]."""
    from scipy.linalg import lu_factor, lu_solve

    # The load cancels the susceptance of the element.
    loaded = (np.diagonal(elements).real + network.conductance_s
              + 1j * network.susceptance_slope_s * (frames - 0.5))
    factors = []
    for diagonal in loaded:
        matrix = elements.copy()
        np.fill_diagonal(matrix, diagonal)
        factors.append(lu_factor(matrix, overwrite_a=True, check_finite=False))
    return factors, np.array([lu_solve(one, between, check_finite=False) for one in factors])


def _between(known_hz: np.ndarray, wanted_hz: np.ndarray) -> tuple[tuple[int, ...], np.ndarray]:
    """Return indices of known frequencies, and weights [J, P] that interpolate to wanted ones."""
    above = np.searchsorted(known_hz, wanted_hz * (1 - _ROUNDING))
    above = np.minimum(above, len(known_hz) - 1)
    is_known = np.abs(known_hz[above] - wanted_hz) <= _ROUNDING * wanted_hz
    below = np.where(is_known, above, above - 1)
    steps = known_hz[above] - known_hz[below]
    fits = is_known | (below >= 0) & (known_hz[above] > wanted_hz) & (
        steps <= _MAX_STEP * wanted_hz)
    if not fits.all():
        raise BoardError(
            f'no admittances at {wanted_hz[~fits][0]:.9g} Hz, expected this frequency, or '
            f'frequencies on both sides that differ by at most {100 * _MAX_STEP:g} %')
    points, where = np.unique(np.concatenate([below, above]), return_inverse=True)
    share = np.where(is_known, 1.0, (wanted_hz - known_hz[below]) / np.where(is_known, 1, steps))
    weights = np.zeros((len(wanted_hz), len(points)))
    rows, half = np.arange(len(wanted_hz)), len(wanted_hz)
    weights[rows, where[:half]] += 1 - share
    weights[rows, where[half:]] += share
    return tuple(points.tolist()), weights
