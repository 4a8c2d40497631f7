"""Recordings of samples: their files, and playback that yields the same signals bit for bit."""

import concurrent.futures
import dataclasses
import hashlib
import json
import math
import sys
import threading

import numpy as np
import pytest

from rhs_isac_ros.frontend import (
    Air,
    EmulatedRadio,
    EmulatedSurface,
    FrontEnd,
    RadioFault,
    SampleRecorder,
    Sounding,
    Waveform,
    WaveformRadio,
    make_radio,
)
from rhs_isac_ros.model import Scenario, ScenarioError

SCENARIO = Scenario(
    n_frames=4, frame_duration_s=0.015, n_feeds=2, n_subbands=4, elements_per_side=4,
    center_frequencies_hz=(5e9, 6e9), band_phase_std_rad=6.2832, timing_std_s=1e-7,
    roi_center_m=(4, 0, 0), roi_size_m=(4, 4, 1))
# A collection has 512 frames: 64 cycles.
N_CYCLES = 70


@pytest.fixture(autouse=True)
def sigmf():
    return pytest.importorskip('sigmf', reason='sigmf is not installed')


class Float32Radio(WaveformRadio):
    """A radio with samples of single precision, and another clock than the user."""

    def __init__(self, scenario, air):
        super().__init__(scenario, air, clock_ppm=1.0)

    def capture(self, band, pilot):
        return super().capture(band, pilot).astype(np.complex64)


def configurations(band):
    return np.random.default_rng(band).integers(0, 2, (4, 16)).astype(float)


def sounding(rng, cycle_id, band):
    """Return the sounding of a band with random signals and symbols."""
    return Sounding(
        cycle_id, band, symbols=np.exp(2j * np.pi * rng.random(4)),
        arriving=rng.normal(size=(4, 4, 2, 2)) @ [1, 1j],
        user=7, position_m=rng.normal(size=3), velocity_mps=rng.normal(size=3),
        stamp_ns=1_700_000_000_000_000_001)


def record(folder, order, radio=WaveformRadio, scenario=SCENARIO):
    """Record the pairs of cycle and band in `order`; return their soundings and signals."""
    rng = np.random.default_rng(0)
    air = Air(scenario, rng)
    radio = radio(scenario, air)
    front_end = FrontEnd(EmulatedSurface(16), radio, air, SampleRecorder(
        folder, scenario, radio.modem, pytest.fail))
    assert front_end.waits
    sent = [sounding(rng, *one) for one in order]
    feeds = [front_end.sound(configurations(one.band), one) for one in sent]
    front_end.close()
    return sent, feeds


def playback(path, scenario=SCENARIO):
    """Return the radio that plays a recording, and its air."""
    air = Air(scenario, np.random.default_rng(1))
    return make_radio('sigmf', scenario, air, path=str(path)), air


def player(path):
    """Return a function that plays a band of a cycle, with other signals and symbols."""
    front_end, rng = FrontEnd(EmulatedSurface(16), *playback(path)), np.random.default_rng(2)
    return front_end, lambda cycle_id, band: front_end.sound(
        configurations(0), sounding(rng, cycle_id, band))


def cycles(n):
    return [(cycle, band) for cycle in range(1, n + 1) for band in (0, 1)]


@pytest.mark.slow
@pytest.mark.parametrize('radio', [WaveformRadio, Float32Radio])
def test_playback_yields_the_same_signals_bit_for_bit(tmp_path, radio):
    _, feeds = record(tmp_path / 'samples', cycles(N_CYCLES), radio)
    assert len(list(tmp_path.glob('samples/*.sigmf-collection'))) == 2
    front_end, play = player(tmp_path / 'samples')
    for _ in range(2):
        for (cycle, band), signals in zip(cycles(N_CYCLES), feeds, strict=True):
            np.testing.assert_array_equal(play(100 + cycle, band), signals)
        with pytest.raises(RadioFault, match=f'EOFError: .*: all {N_CYCLES} cycles are played'):
            play(999, 0)
        # A released radio begins again.
        front_end.close()


def test_a_repeated_request_plays_the_same_cycle(tmp_path):
    _, feeds = record(tmp_path, [(1, 0), (1, 0), (1, 1), (2, 0)])
    _, play = player(tmp_path)
    for band, expected in ((0, 0), (0, 0), (1, 2), (0, 0)):
        np.testing.assert_array_equal(play(5, band), feeds[expected])
    np.testing.assert_array_equal(play(6, 0), feeds[3])
    with pytest.raises(RadioFault, match='LookupError: .*: band 1 is missing in cycle 2'):
        play(6, 1)


def test_the_library_accepts_the_files_without_a_warning(tmp_path, sigmf):
    from sigmf import validate

    record(tmp_path, cycles(2))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [
        'part-000001-feed0.sigmf-data', 'part-000001-feed0.sigmf-meta',
        'part-000001-feed1.sigmf-data', 'part-000001-feed1.sigmf-meta',
        'part-000001.sigmf-collection']
    validate.main(tuple(str(path) for path in tmp_path.glob('*.sigmf-meta')))
    # The program cannot check collections. Reading one compares its checksums.
    collection = sigmf.fromfile(tmp_path / names[-1])
    assert collection.get_stream_names() == ['part-000001-feed0', 'part-000001-feed1']
    assert collection.get_SigMFFile('part-000001-feed1').sample_count == len(
        (tmp_path / names[2]).read_bytes()) / 16


def test_frames_are_annotated(tmp_path):
    sent, _ = record(tmp_path, cycles(2))
    meta = json.loads((tmp_path / 'part-000001-feed1.sigmf-meta').read_text(encoding='utf-8'))
    about, frame = meta['global'], meta['annotations'][9]
    assert about['core:datatype'] == 'cf64_le'
    assert about['core:sample_rate'] == 1e6
    assert about['core:collection'] == 'part-000001'
    assert Scenario(**about['rhs_isac:scenario']) == SCENARIO
    # The second cycle shows the same configurations as the first.
    assert len(about['rhs_isac:configurations']) == 8
    assert about['rhs_isac:configurations'][frame['rhs_isac:configuration']] == (
        configurations(0)[1].tolist())
    assert {name: frame[f'rhs_isac:{name}'] for name in ('cycle_id', 'band', 'frame', 'user')} == {
        'cycle_id': 2, 'band': 0, 'frame': 1, 'user': 7}
    assert frame['rhs_isac:position_m'] == sent[2].position_m.tolist()
    assert frame['rhs_isac:velocity_mps'] == sent[2].velocity_mps.tolist()
    assert complex(*frame['rhs_isac:symbol']) == sent[2].symbols[1]
    assert meta['captures'][4] == {
        'core:sample_start': meta['annotations'][4]['core:sample_start'], 'core:frequency': 6e9,
        'core:datetime': '2023-11-14T22:13:20.000000001Z'}


def test_a_folder_may_contain_several_recordings(tmp_path):
    feeds = [record(tmp_path, cycles(n))[1] for n in (2, 1)]
    _, play = player(tmp_path)
    for cycle, expected in enumerate((feeds[0][0], feeds[0][2], feeds[1][0])):
        np.testing.assert_array_equal(play(cycle, 0), expected)
    _, play = player(tmp_path / 'part-000002.sigmf-collection')
    np.testing.assert_array_equal(play(1, 0), feeds[1][0])


@pytest.mark.parametrize(('changes', 'text'), [
    ({'n_frames': 5}, r'part-000001\.sigmf-collection: n_frames: 4, expected 5'),
    ({'center_frequencies_hz': (5e9, 7e9)},
     r'center_frequencies_hz: \[5000000000\.0, 6000000000\.0\], expected \[5000000000.*7'),
    ({'user_gain': 2.0}, 'user_gain: .*, expected 2.0')])
def test_a_recording_of_another_scenario_is_refused(tmp_path, changes, text):
    record(tmp_path, cycles(1))
    with pytest.raises(ScenarioError, match=text):
        playback(tmp_path, dataclasses.replace(SCENARIO, **changes))


def test_files_that_are_no_recording_are_refused(tmp_path):
    with pytest.raises(ValueError, match='no collections, expected files'):
        playback(tmp_path)
    with pytest.raises(ValueError, match='missing: cannot be read: '):
        playback(tmp_path / 'missing')
    record(tmp_path, cycles(1))
    data = tmp_path / 'part-000001-feed0.sigmf-data'
    data.write_bytes(bytes([data.read_bytes()[0] ^ 1]) + data.read_bytes()[1:])
    with pytest.raises(ValueError, match='cannot be read: Calculated file hash does not match'):
        playback(tmp_path)


class Edited:
    """A recording of two cycles as another tool leaves it, with the hashes renewed."""

    def __init__(self, folder):
        self._folder = folder
        _, self.feeds = record(folder, cycles(2))
        self.names = [f'part-000001-feed{feed}' for feed in (0, 1)]
        self.metas = [json.loads(self.file(name, 'meta').read_bytes()) for name in self.names]
        self.data = [np.fromfile(self.file(name, 'data'), '<c16') for name in self.names]

    def file(self, name, kind):
        return self._folder / f'{name}.sigmf-{kind}'

    def play(self):
        """Return the signals, or raise the error of the radio."""
        streams = []
        for name, meta, data in zip(self.names, self.metas, self.data, strict=True):
            data.tofile(self.file(name, 'data'))
            digest = hashlib.sha512(self.file(name, 'data').read_bytes()).hexdigest()
            meta['global']['core:sha512'] = digest
            text = json.dumps(meta).encode()
            self.file(name, 'meta').write_bytes(text)
            streams.append({'name': name, 'hash': hashlib.sha512(text).hexdigest()})
        path = self.file('part-000001', 'collection')
        content = json.loads(path.read_bytes())
        content['collection']['core:streams'] = streams
        path.write_text(json.dumps(content), encoding='utf-8')
        _, play = player(self._folder)
        return [play(*one) for one in cycles(2)]


def add_label(edited):
    edited.metas[0]['annotations'].insert(3, {
        'core:sample_start': 5, 'core:sample_count': 10**6, 'core:label': 'a bird'})


def shuffle_frames(edited):
    for meta in edited.metas:
        meta['annotations'].reverse()


def shuffle_streams(edited):
    for each in (edited.names, edited.metas, edited.data):
        each.reverse()


def add_stream(edited):
    edited.names.append('microphone')
    edited.metas.append({'global': {'core:datatype': 'cf64_le', 'core:version': '1.0.0'},
                         'captures': [{'core:sample_start': 0}], 'annotations': []})
    edited.data.append(np.zeros(10, '<c16'))


def split_captures(edited):
    for meta in edited.metas:
        meta['captures'] = [one | {'core:sample_start': one['core:sample_start'] + more}
                            for one in meta['captures'] for more in (0, 7)]


def merge_captures(edited):
    for meta in edited.metas:
        meta['captures'] = [one for n, one in enumerate(meta['captures']) if n % 4 == 0]


def move_start(edited):
    """As in the second of several files of one stream."""
    for meta in edited.metas:
        meta['global']['core:offset'] = 1000
        for one in (*meta['captures'], *meta['annotations']):
            one['core:sample_start'] += 1000


def swap_bytes(edited):
    for n, meta in enumerate(edited.metas):
        meta['global']['core:datatype'] = 'cf64_be'
        edited.data[n] = edited.data[n].astype('>c16')


def write_floats(edited):
    for meta in edited.metas:
        for one in (*meta['captures'], *meta['annotations']):
            one.update({name: float(value) for name, value in one.items() if type(value) is int})


@pytest.mark.parametrize('edit', [
    add_label, shuffle_frames, shuffle_streams, add_stream, split_captures, merge_captures,
    move_start, swap_bytes, write_floats])
def test_what_other_tools_may_change_changes_no_signals(tmp_path, edit):
    edited = Edited(tmp_path)
    edit(edited)
    np.testing.assert_array_equal(edited.play(), edited.feeds)


def test_samples_of_single_precision_are_played(tmp_path):
    edited = Edited(tmp_path)
    for n, meta in enumerate(edited.metas):
        meta['global']['core:datatype'] = 'cf32_le'
        edited.data[n] = edited.data[n].astype('<c8')
    np.testing.assert_allclose(edited.play(), edited.feeds, rtol=1e-4)


@pytest.mark.parametrize(('part', 'name', 'value', 'text'), [
    ('global', 'core:sample_rate', 2e6, '2000000.0, expected 1000000.0'),
    ('global', 'core:num_channels', 2, '2, expected 1'),
    ('global', 'core:datatype', 'ci16_le', "'ci16_le', expected 'cf32_le' or"),
    ('global', 'core:trailing_bytes', 16, '16, expected 0'),
    ('global', 'rhs_isac:feed', 0, r'\[0, 0\], expected one stream for each of n_feeds = 2'),
    ('global', 'rhs_isac:scenario', None, 'None, expected fields'),
    ('captures', 'core:frequency', 1e9, '1000000000.0, expected 5000000000.0'),
    ('captures', 'core:header_bytes', 16, '16, expected 0'),
    ('annotations', 'rhs_isac:frame', 2, r'\[0, 1, 2, 2\], expected \[0, 1, 2, 3\]'),
    ('annotations', 'rhs_isac:band', 5, '5, expected 0'),
    ('annotations', 'rhs_isac:cycle_id', 7, '7, expected 1'),
    ('annotations', 'rhs_isac:cycle_id', None, 'None, expected an integer'),
    ('annotations', 'rhs_isac:time_s', math.nan, 'nan, expected'),
    ('annotations', 'rhs_isac:symbol', [0, 0], r'\[0.0, 0.0\], expected a complex number'),
    ('annotations', 'core:sample_count', 10, '10, expected 58'),
    ('annotations', 'core:sample_start', -1, '-1 with 58 samples, expected within 0 to'),
    ('annotations', 'core:sample_start', 10**6, '1000000 with 58 samples, expected within 0'),
])
def test_contradictions_are_refused_by_name(tmp_path, part, name, value, text):
    edited = Edited(tmp_path)
    about = edited.metas[1][part]
    (about if part == 'global' else about[3]).update({name: value})
    with pytest.raises(ValueError, match=rf'part-000001\.sigmf-collection: .*{name}.*: {text}'):
        edited.play()


def test_streams_that_contradict_each_other_are_refused(tmp_path):
    edited = Edited(tmp_path)
    edited.metas[1]['annotations'][3]['rhs_isac:symbol'] = [0.6, 0.8]
    with pytest.raises(ValueError, match='feed 1: other annotations than those of feed 0'):
        edited.play()


def test_incomplete_data_are_refused_before_the_first_cycle(tmp_path):
    edited = Edited(tmp_path)
    edited.data[1] = edited.data[1][:-20]
    with pytest.raises(ValueError, match='feed 1: core:sample_start: .* expected within 0 to'):
        edited.play()


def test_samples_that_are_no_numbers_are_a_fault_of_the_radio(tmp_path):
    # After the end of the frame, where the synchronisation might not look.
    edited = Edited(tmp_path)
    edited.data[1][100:110] = np.nan
    with pytest.raises(RadioFault, match='^captures: .*, expected '):
        edited.play()


def test_streams_without_data_and_files_that_are_no_collections_are_named(tmp_path):
    edited = Edited(tmp_path)
    with pytest.raises(ValueError, match='a single stream or an archive, expected a collection'):
        playback(edited.file(edited.names[0], 'meta'))
    edited.file(edited.names[1], 'data').unlink()
    with pytest.raises(ValueError, match='feed 1: no samples, expected a file'):
        playback(tmp_path)


def test_a_later_collection_is_checked_at_the_start(tmp_path):
    record(tmp_path, cycles(1))
    Edited(tmp_path)  # Another one.
    data = tmp_path / 'part-000002-feed1.sigmf-data'
    data.write_bytes(data.read_bytes()[:-16])
    with pytest.raises(ValueError, match=r'part-000002\.sigmf-collection: feed 1: core:sample'):
        playback(tmp_path)


def test_the_cycles_of_two_recordings_differ(tmp_path):
    """Also if the last one and the first one have the same number."""
    feeds = [record(tmp_path, cycles(1))[1] for _ in range(2)]
    _, play = player(tmp_path)
    for cycle, expected in enumerate(feeds):
        np.testing.assert_array_equal(play(cycle, 0), expected[0])


def test_recorders_that_write_to_a_folder_at_the_same_time_replace_nothing(tmp_path):
    start = threading.Barrier(4)

    def record_part(n):
        rng = np.random.default_rng(n)
        recorder = SampleRecorder(tmp_path, SCENARIO, Waveform(SCENARIO), pytest.fail)
        recorder.add(configurations(0), sounding(rng, n, 0), rng.normal(size=(4, 2, 9)), [0] * 4)
        start.wait(10)
        recorder.close()

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        list(pool.map(record_part, range(4)))
    found = {json.loads(path.read_text())['annotations'][0]['rhs_isac:cycle_id']
             for path in tmp_path.glob('part-*-feed0.sigmf-meta')}
    assert found == {0, 1, 2, 3}
    assert len([*tmp_path.iterdir()]) == 4 * (1 + 2 * 2)


def test_a_failed_recording_ends_and_measurement_continues(tmp_path):
    air, reasons = Air(SCENARIO, np.random.default_rng(0)), []
    radio = WaveformRadio(SCENARIO, air)
    front_end = FrontEnd(EmulatedSurface(16), radio, air, SampleRecorder(
        tmp_path / 'samples', SCENARIO, radio.modem, reasons.append))
    (tmp_path / 'samples').rmdir()
    rng = np.random.default_rng(0)
    for _ in range(2):
        front_end.sound(configurations(0), sounding(rng, 1, 0))
        front_end.close()
    assert reasons == [f'{tmp_path}/samples: samples cannot be written: No such file or '
                       'directory; the recording has ended']


def test_a_radio_without_samples_cannot_be_recorded(tmp_path):
    with pytest.raises(ValueError, match='modem EmulatedRadio, expected a radio with the modem'):
        SampleRecorder(tmp_path, SCENARIO, EmulatedRadio(SCENARIO, None), pytest.fail)


def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'sigmf', None)
    hint = r"needs sigmf, which is not installed \(pip install 'rhs_isac_ros\[samples\]'; in a"
    with pytest.raises(ValueError, match=f'recording samples {hint}'):
        SampleRecorder(tmp_path, SCENARIO, Waveform(SCENARIO), pytest.fail)
    with pytest.raises(ValueError, match=f'radio sigmf {hint}'):
        playback(tmp_path)
