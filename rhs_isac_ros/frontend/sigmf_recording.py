"""Samples of a radio as collections in the format SigMF, and a radio that plays them back.

A recording is a folder with one collection after the other. A collection contains a stream for
each feed, with the frames of some cycles. Keys of SigMF begin with ``core:``, and those of this
package with ``rhs_isac:``. The library sigmf is optional.
"""

import bisect
import contextlib
import dataclasses
import datetime
import itertools
import json
import math
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.frontend.radio import Air, Modem, Sounding
from rhs_isac_ros.frontend.waveform import Waveform
from rhs_isac_ros.model.arrays import numbers
from rhs_isac_ros.model.scenario import Scenario, ScenarioError
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import finite
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

_EXTENSION = {'name': 'rhs_isac', 'version': '1.0.0', 'optional': True}
# A collection ends with the cycle in which it reaches this number of frames: a process that is
# killed loses the frames since then.
_N_FRAMES = 512
# Part of the report.
SAMPLES_FAILED = 'samples cannot be written'
_DATATYPES = {'<c8': 'cf32_le', '<c16': 'cf64_le'}
# Integers would have lost the unit.
_READABLE = (*_DATATYPES.values(), 'cf32_be', 'cf64_be')
_FEED = 'rhs_isac:feed'


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
                'rhs_isac:position_m': sounding.position_m.tolist(),
                'rhs_isac:velocity_mps': sounding.velocity_mps.tolist()})
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
            self._report(f'{self._folder}: {SAMPLES_FAILED}: {error.strerror}; the recording has '
                         'ended')

    def _write(self, found: _Collection) -> None:
        import sigmf

        with self._part() as folder:
            name = folder.name.removeprefix('.')
            streams = [self._write_feed(folder / f'{name}-feed{feed}', feed, found)
                       for feed in range(self._scenario.n_feeds)]
            sigmf.SigMFCollection(streams, {'collection': {
                'core:description': 'Samples at the feeds of a holographic surface.',
                'core:extensions': [_EXTENSION]}}, base_path=folder).tofile(folder / name)
            # The collection is the last one, because it refers to the others.
            for path in sorted(folder.iterdir(), key=lambda path: (path.stem == name, path)):
                path.replace(self._folder / path.name)

    @contextlib.contextmanager
    def _part(self) -> Iterator[Path]:
        """Create a hidden directory for the files of the next part, and remove it at the end.

        Several recorders may write to one folder: the directory reserves the name of the part.
        """
        last = max((path.stem for path in self._folder.glob('part-*.sigmf-collection')),
                   default='part-0')
        for number in itertools.count(int(last.removeprefix('part-')) + 1):
            folder = self._folder / f'.part-{number:06}'
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            try:
                # Another recorder may have completed this part since the search for the last one.
                if not (self._folder / f'part-{number:06}.sigmf-collection').exists():
                    yield folder
                    return
            finally:
                shutil.rmtree(folder)

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
            _FEED: feed, 'rhs_isac:scenario': self._scenario.changes(),
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
        # A recording that cannot be played is an error at once, not during a cycle.
        for one in _collections(self._path):
            _streams(one, scenario, skip_checksum=True)
        next(_cycles(self._path, scenario))
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
        """Return the recorded samples of the present frame, complex [K, n].

        Raises EOFError after the last cycle, and LookupError if the cycle lacks the band.
        """
        if self._air.cycle_id != self._cycle_id:
            self._cycle = next(self._cycles, {})
            self._cycle_id = self._air.cycle_id
            self._n_cycles += bool(self._cycle)
        if not self._cycle:
            raise EOFError(f'{self._path}: all {self._n_cycles} cycles are played')
        if band not in self._cycle:
            raise LookupError(f'{self._path}: band {band} is missing in cycle {self._n_cycles}')
        return self._cycle[band].captures[self._air.frame]

    def close(self) -> None:
        """Return to the beginning."""
        self._cycles = _cycles(self._path, self._scenario)
        self._cycle, self._cycle_id, self._n_cycles = {}, None, 0


class _Frame(NamedTuple):
    """A frame in the stream of a feed: an annotation with keys of this package."""

    sounding: int
    frame: int
    cycle_id: int
    band: int
    symbol: complex
    time_s: float
    n_samples: int
    start: int  # index in the data


def _collections(path: Path) -> list[Path]:
    """Return the collections of a recording; raise ValueError if there are none."""
    paths = sorted(path.glob('*.sigmf-collection')) if path.is_dir() else [path]
    if not paths:
        raise ValueError(f'{path}: no collections, expected files *.sigmf-collection')
    return paths


def _cycles(path: Path, scenario: Scenario) -> Iterator[Mapping[int, _Recorded]]:
    """Yield the bands of each cycle; raise ValueError if a collection cannot be played."""
    for one in _collections(path):
        for _, group in itertools.groupby(_read(one, scenario), lambda band: band.cycle_id):
            cycle: dict[int, _Recorded] = {}
            for band in group:
                cycle.setdefault(band.band, band)
            yield cycle


def _read(path: Path, scenario: Scenario) -> Iterator[_Recorded]:
    """Yield the bands of a collection."""
    streams = _streams(path, scenario)
    n_frames = scenario.n_frames
    for first in range(0, len(streams[0][1]), n_frames):
        spans = [[slice(frame.start, frame.start + frame.n_samples)
                  for frame in frames[first:first + n_frames]] for _, frames in streams]
        frames = streams[0][1][first:first + n_frames]
        # Slices keep the type of the samples; read_samples() would return complex64.
        yield _Recorded(
            frames[0].cycle_id, frames[0].band, np.array([frame.symbol for frame in frames]),
            np.swapaxes([[feed[span] for span in of_feed]
                         for (feed, _), of_feed in zip(streams, spans, strict=True)], 0, 1),
            np.array([frame.time_s for frame in frames]))


def _streams(path: Path, scenario: Scenario, skip_checksum: bool = False
             ) -> list[tuple[Any, list[_Frame]]]:
    """Return the streams of a collection with their frames, in the order of the feeds.

    What other tools add is ignored. Raises ScenarioError if the recording is of another scenario,
    and ValueError if it contradicts the scenario or itself, or the data are incomplete.
    """
    import sigmf

    # For a damaged file, sigmf raises many kinds of exceptions; of incomplete data, it warns.
    with translated(Exception, ValueError, f'{path}: cannot be read'), warnings.catch_warnings():
        warnings.simplefilter('ignore')
        collection = sigmf.fromfile(path, skip_checksum=skip_checksum)
        if not isinstance(collection, sigmf.SigMFCollection):
            raise ValueError('a single stream or an archive, expected a collection of streams, '
                             '*.sigmf-collection, beside their files')
        feeds = [feed for name in collection.get_stream_names()
                 if (feed := collection.get_SigMFFile(name)).get_global_field(_FEED) is not None]
    feeds.sort(key=lambda feed: feed.get_global_field(_FEED))
    for feed in feeds:
        _check_scenario(path, feed.get_global_field('rhs_isac:scenario'), scenario)
    found = [feed.get_global_field(_FEED) for feed in feeds]
    if found != [*range(scenario.n_feeds)]:
        raise ValueError(f'{path}: {_FEED}: {found}, expected one stream for each of n_feeds = '
                         f'{scenario.n_feeds} feeds, from 0')
    streams = []
    for number, feed in enumerate(feeds):
        with translated(Exception, ValueError, f'{path}: feed {number}'):
            streams.append((feed, _frames(feed, scenario)))
        if [frame[:-1] for frame in streams[-1][1]] != [frame[:-1] for frame in streams[0][1]]:
            raise ValueError(f'{path}: feed {number}: other annotations than those of feed 0')
    return streams


def _frames(feed: Any, scenario: Scenario) -> list[_Frame]:
    """Return the frames of a stream in the order of the measurements, all of them complete."""
    about, captures = feed.get_global_info(), feed.get_captures()
    if feed.data_file is None:
        raise ValueError('no samples, expected a file *.sigmf-data beside the metadata')
    _expect('core:datatype', about.get('core:datatype'), *_READABLE)
    _expect('core:num_channels', about.get('core:num_channels', 1), 1)
    _expect('core:trailing_bytes', about.get('core:trailing_bytes', 0), 0)
    rate_hz = Waveform(scenario).sample_rate_hz
    _expect('core:sample_rate', about.get('core:sample_rate', rate_hz), rate_hz)
    offset = _integer('core:offset', about.get('core:offset', 0))
    captures = sorted(captures, key=lambda one: _integer(
        'core:sample_start', one.get('core:sample_start')))
    for capture in captures:
        _expect('core:header_bytes', capture.get('core:header_bytes', 0), 0)
    frames = sorted((_frame(one, offset) for one in feed.get_annotations()
                     if any(key.startswith('rhs_isac:') for key in one)),
                    key=lambda frame: (frame.sounding, frame.frame))
    if not frames:
        raise ValueError('no annotations with keys rhs_isac, expected one for each frame')
    starts = [capture['core:sample_start'] - offset for capture in captures]
    for _, group in itertools.groupby(frames, lambda frame: frame.sounding):
        of_band = list(group)
        first = of_band[0]
        _expect(f'rhs_isac:frame of sounding {first.sounding}',
                [frame.frame for frame in of_band], [*range(scenario.n_frames)])
        _expect('rhs_isac:band', first.band, *range(scenario.n_bands))
        for frame in of_band:
            _expect('rhs_isac:cycle_id', frame.cycle_id, first.cycle_id)
            _expect('rhs_isac:band', frame.band, first.band)
            _expect('core:sample_count', frame.n_samples, first.n_samples)
            end = frame.start + frame.n_samples
            if not 0 <= frame.start < end <= len(feed):
                raise ValueError(f'core:sample_start: {frame.start + offset} with '
                                 f'{frame.n_samples} samples, expected within {offset} to '
                                 f'{offset + len(feed)}')
            expected_hz = scenario.center_frequencies_hz[frame.band]
            for capture in captures[max(bisect.bisect(starts, frame.start) - 1, 0):
                                    bisect.bisect_left(starts, end)]:
                _expect('core:frequency', capture.get('core:frequency', expected_hz), expected_hz)
    return frames


def _frame(annotation: Mapping[str, Any], offset: int) -> _Frame:
    """Return the frame of an annotation of a stream whose first sample has an index."""
    sounding, frame, cycle_id, band, n_samples, start = (
        _integer(name, annotation.get(name)) for name in (
            'rhs_isac:sounding', 'rhs_isac:frame', 'rhs_isac:cycle_id', 'rhs_isac:band',
            'core:sample_count', 'core:sample_start'))
    parts = numbers('rhs_isac:symbol', annotation.get('rhs_isac:symbol', ()))
    if parts.shape != (2,) or not parts.any():
        raise ValueError(f'rhs_isac:symbol: {parts.tolist()}, expected a complex number but 0')
    time_s = finite('rhs_isac:time_s', annotation.get('rhs_isac:time_s'))
    return _Frame(sounding, frame, cycle_id, band, complex(*parts.tolist()), time_s, n_samples,
                  start - offset)


def _integer(name: str, value: Any) -> int:
    # Some tools write all numbers with a point.
    if type(value) is not int and not (isinstance(value, float) and value.is_integer()):
        raise ValueError(f'{name}: {value!r}, expected an integer')
    return int(value)


def _expect(name: str, value: Any, *expected: Any) -> None:
    """Raise ValueError unless a value equals one of those expected, up to rounding."""
    if value not in expected and not any(
            isinstance(value, int | float) and isinstance(one, int | float)
            and math.isclose(value, one, rel_tol=1e-9) for one in expected):
        raise ValueError(f'{name}: {value!r}, expected {" or ".join(map(repr, expected))}')


def _check_scenario(path: Path, recorded: Any, scenario: Scenario) -> None:
    """Raise ScenarioError unless the fields that differ from their defaults are the same."""
    if not isinstance(recorded, Mapping):
        raise ScenarioError(f'{path}: rhs_isac:scenario: {recorded!r}, expected fields')
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
