"""Samples of a radio as collections in the format SigMF, and a radio that plays them back.

A recording is a folder with one collection after the other. A collection contains a stream for
each feed, with the frames of some cycles. Keys of SigMF begin with ``core:``, and those of this
package with ``rhs_isac:``. The library sigmf is optional.
"""

import contextlib
import dataclasses
import datetime
import itertools
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.frontend.radio import Air, Modem, Sounding
from rhs_isac_ros.frontend.waveform import Waveform
from rhs_isac_ros.model.scenario import Scenario, ScenarioError
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

_EXTENSION = {'name': 'rhs_isac', 'version': '1.0.0', 'optional': True}
# A collection ends with the cycle in which it reaches this number of frames: a process that is
# killed loses the frames since then.
_N_FRAMES = 512
_DATATYPES = {'<c8': 'cf32_le', '<c16': 'cf64_le'}


@contextlib.contextmanager
def _library(purpose: str) -> Iterator[None]:
    """Import sigmf; the error of a missing library is that of an invalid parameter."""
    with translated(MissingLibraryError, ValueError), optional_import(purpose, extra='samples'):
        yield


@dataclasses.dataclass
class _Collection:
    """The frames of a collection, and their metadata."""

    frames: list[np.ndarray] = dataclasses.field(default_factory=list)  # complex [K, n]
    captures: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    annotations: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    # Numbers of the configurations, which repeat in each cycle.
    configurations: dict[tuple[float, ...], int] = dataclasses.field(default_factory=dict)
    n_samples: int = 0
    n_soundings: int = 0
    cycle_id: int = 0


class SampleRecorder:
    """Writes the samples of all frames to a folder, as SigMF collections.

    A collection is written aside, and renamed when it is complete. If writing fails, for example
    because the disk is full, the recording ends, and `report` is called with the reason.

    Raises ValueError if the radio has no samples or sigmf is not installed, and OSError if the
    folder cannot be created.
    """

    def __init__(self, folder: str | Path, scenario: Scenario, modem: Modem,
                 report: Callable[[str], object]) -> None:
        if not isinstance(modem, Waveform):
            raise ValueError(f'{folder}: modem {type(modem).__name__}, expected a radio with the '
                             'modem Waveform, such as waveform')
        with _library('recording samples'):
            import sigmf  # noqa: F401
        self._folder, self._scenario, self._report = Path(folder), scenario, report
        self._sample_rate_hz = modem.sample_rate_hz
        self._folder.mkdir(parents=True, exist_ok=True)
        self._collection: _Collection | None = _Collection()

    def add(self, configurations: np.ndarray, sounding: Sounding, captures: np.ndarray,
            times_s: Sequence[float]) -> None:
        """Add the frames of a band: configurations [F, N_E], samples [F, K, n], times [F]."""
        found = self._collection
        if found and len(found.frames) >= _N_FRAMES and found.cycle_id != sounding.cycle_id:
            self.close()
            found = self._collection
        if found is None:
            return
        for frame, (configuration, samples) in enumerate(
                zip(configurations, captures, strict=True)):
            number = found.configurations.setdefault(
                tuple(configuration.tolist()), len(found.configurations))
            symbol = complex(sounding.symbols[frame])
            found.frames.append(samples)
            found.captures.append({
                'core:sample_start': found.n_samples,
                'core:frequency': self._scenario.center_frequencies_hz[sounding.band]})
            if not frame:
                found.captures[-1]['core:datetime'] = _date(sounding.stamp_ns)
            found.annotations.append({
                'core:sample_start': found.n_samples, 'core:sample_count': samples.shape[1],
                'rhs_isac:sounding': found.n_soundings, 'rhs_isac:cycle_id': sounding.cycle_id,
                'rhs_isac:band': sounding.band, 'rhs_isac:frame': frame,
                'rhs_isac:configuration': number, 'rhs_isac:time_s': times_s[frame],
                'rhs_isac:symbol': [symbol.real, symbol.imag],
                'rhs_isac:user': sounding.user,
                'rhs_isac:position_m': sounding.position_m.tolist()})
            found.n_samples += samples.shape[1]
        found.n_soundings, found.cycle_id = found.n_soundings + 1, sounding.cycle_id

    def close(self) -> None:
        """Complete the present collection; the next frames begin another one."""
        found = self._collection
        if not found or not found.frames:
            return
        try:
            self._write(found)
            self._collection = _Collection()
        except OSError as error:
            self._collection = None
            self._report(f'{self._folder}: samples cannot be written: {error.strerror}; the '
                         'recording has ended')

    def _write(self, found: _Collection) -> None:
        import sigmf

        last = max((path.stem for path in self._folder.glob('part-*.sigmf-collection')),
                   default='part-0')
        name = f'part-{int(last.removeprefix("part-")) + 1:06}'
        with tempfile.TemporaryDirectory(prefix='.', dir=self._folder) as temporary:
            folder = Path(temporary)
            streams = [self._write_feed(folder / f'{name}-feed{feed}', feed, found)
                       for feed in range(self._scenario.n_feeds)]
            sigmf.SigMFCollection(streams, {'collection': {
                'core:description': 'Samples at the feeds of a holographic surface.',
                'core:extensions': [_EXTENSION]}}, base_path=folder).tofile(folder / name)
            # The collection is the last one, because it refers to the others.
            for path in sorted(folder.iterdir(), key=lambda path: (path.stem == name, path)):
                path.replace(self._folder / path.name)

    def _write_feed(self, path: Path, feed: int, found: _Collection) -> str:
        """Write the samples of a feed and their metadata; return the name of the latter."""
        import sigmf

        data = path.with_name(f'{path.name}.sigmf-data')
        kind = '<c8' if found.frames[0].dtype == np.complex64 else '<c16'
        with data.open('wb') as stream:
            for samples in found.frames:
                stream.write(samples[feed].astype(kind).tobytes())
        metadata = {'global': {
            'core:datatype': _DATATYPES[kind], 'core:sample_rate': self._sample_rate_hz,
            'core:recorder': f'rhs_isac_ros {__version__}',
            'core:collection': path.name.rpartition('-')[0],
            'core:extensions': [_EXTENSION],
            'rhs_isac:feed': feed, 'rhs_isac:scenario': self._scenario.changes(),
            'rhs_isac:configurations': list(map(list, found.configurations))},
            'captures': found.captures, 'annotations': found.annotations}
        # Validation takes longer than all the rest; the tests validate.
        sigmf.SigMFFile(metadata, data).tofile(path, pretty=False, skip_validate=True)
        return f'{path.name}.sigmf-meta'


@dataclasses.dataclass(frozen=True)
class _Recorded:
    """The frames of a band in a recording."""

    cycle_id: int
    band: int
    symbols: np.ndarray   # complex128 [F]
    captures: np.ndarray  # complex [F, K, n]
    times_s: np.ndarray   # float64 [F]


class PlaybackRadio:
    """A radio that plays a recording back, one recorded cycle for each cycle of the network.

    The signals are those of the recorded symbols. If a band was measured more than once in a
    cycle, the first measurement is played. At the end of the recording, `capture` raises
    EOFError; `close` returns to its beginning.

    Parameters
    ----------
    path : str
        A collection, or a folder of collections.
    """

    # Files may be on a slow disk.
    waits = True
    # Those of the recording are used.
    time_s = 0.0

    def __init__(self, scenario: Scenario, air: Air, *, path: str) -> None:
        with _library('radio sigmf'):
            import sigmf  # noqa: F401
        self._scenario, self._air, self._path = scenario, air, Path(path)
        self._waveform = Waveform(scenario)
        # A recording that cannot be played is an error at once, not during the first cycle.
        next(_cycles(self._path, scenario), None)
        self._cycles = _cycles(self._path, scenario)
        self._cycle: Mapping[int, _Recorded] = {}
        # The id of the cycle in the network, and the number of recorded cycles so far.
        self._cycle_id: int | None = None
        self._n_cycles = 0

    @property
    def modem(self) -> Modem:
        """The radio itself, which replaces the symbols by the recorded ones."""
        return self

    def pilot(self, symbol: complex) -> np.ndarray:
        """Return the samples of a frame, [n_frame]."""
        return self._waveform.pilot(symbol)

    def receive(self, cycle_id: int, captures: np.ndarray, symbols: np.ndarray, band: int,
                times_s: np.ndarray) -> np.ndarray:
        """Return the signals of a band for unit symbols, complex128 [F, N_SB, K]."""
        played = self._cycle[band]
        return self._waveform.receive(
            self._n_cycles, captures, played.symbols, band, played.times_s)

    def status(self) -> Mapping[str, str]:
        """Return timing, carrier and noise, and the number of recorded cycles so far."""
        return {**self._waveform.status(), 'radio.played': str(self._n_cycles)}

    def capture(self, band: int, pilot: np.ndarray) -> np.ndarray:
        """Return the recorded samples of the present frame, complex [K, n]."""
        if self._air.cycle_id != self._cycle_id:
            self._cycle = next(self._cycles, {})
            self._cycle_id = self._air.cycle_id
            self._n_cycles += bool(self._cycle)
        if not self._cycle:
            raise EOFError(f'{self._path}: all {self._n_cycles} cycles are played')
        if band not in self._cycle:
            raise LookupError(f'{self._path}: band {band} is missing in cycle {self._n_cycles}')
        samples: np.ndarray = self._cycle[band].captures[self._air.frame]
        return samples

    def close(self) -> None:
        """Return to the beginning."""
        self._cycles = _cycles(self._path, self._scenario)
        self._cycle, self._cycle_id, self._n_cycles = {}, None, 0


def _cycles(path: Path, scenario: Scenario) -> Iterator[Mapping[int, _Recorded]]:
    """Yield the bands of each cycle; raise ValueError if there are none."""
    paths = sorted(path.glob('*.sigmf-collection')) if path.is_dir() else [path]
    if not paths:
        raise ValueError(f'{path}: no collections, expected files *.sigmf-collection')
    soundings = itertools.chain.from_iterable(_read(one, scenario) for one in paths)
    for _, group in itertools.groupby(soundings, lambda sounding: sounding.cycle_id):
        cycle: dict[int, _Recorded] = {}
        for sounding in group:
            cycle.setdefault(sounding.band, sounding)
        yield cycle


def _read(path: Path, scenario: Scenario) -> Iterator[_Recorded]:
    """Yield the bands of a collection; raise ScenarioError if it is of another scenario."""
    import sigmf

    # For a damaged file, sigmf raises many kinds of exceptions.
    with translated(Exception, ValueError, f'{path}: cannot be read'):
        collection = sigmf.fromfile(path)
        feeds = sorted((collection.get_SigMFFile(name) for name in collection.get_stream_names()),
                       key=lambda feed: feed.get_global_field('rhs_isac:feed'))
        about = dict(feeds[0].get_global_field('rhs_isac:scenario'))
    _check_scenario(path, about, scenario)
    if len(feeds) != scenario.n_feeds:
        raise ValueError(f'{path}: {len(feeds)} streams, expected n_feeds = {scenario.n_feeds}')
    with translated(Exception, ValueError, f'{path}: cannot be read'):
        for _, group in itertools.groupby(
                feeds[0].get_annotations(), lambda frame: frame['rhs_isac:sounding']):
            frames = list(group)
            spans = [slice(frame['core:sample_start'],
                           frame['core:sample_start'] + frame['core:sample_count'])
                     for frame in frames]
            # Slices keep the type of the samples; read_samples() would return complex64.
            yield _Recorded(
                frames[0]['rhs_isac:cycle_id'], frames[0]['rhs_isac:band'],
                np.array([complex(*frame['rhs_isac:symbol']) for frame in frames]),
                np.array([[feed[span] for feed in feeds] for span in spans]),
                np.array([frame['rhs_isac:time_s'] for frame in frames]))


def _check_scenario(path: Path, recorded: Mapping[str, Any], scenario: Scenario) -> None:
    """Raise ScenarioError unless the fields that differ from their defaults are the same."""
    defaults, expected = Scenario().fields(), scenario.fields()
    for name in {**expected, **recorded}:
        found = recorded.get(name, defaults.get(name))
        if _content(found) != _content(expected.get(name)):
            raise ScenarioError(f'{path}: {name}: {found!r}, expected {expected.get(name)!r}')


def _content(value: Any) -> Any:
    """Return a value as it is read from JSON; of a file, the digest without its path."""
    return value.rpartition('@')[2] if isinstance(value, str) else json.loads(json.dumps(value))


def _date(stamp_ns: int) -> str:
    """Return a time since 1970 [ns] in the form of SigMF."""
    time = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.timezone.utc)
    return f'{time:%Y-%m-%dT%H:%M:%S}.{stamp_ns % 10**9:09}Z'
