"""Recordings of samples: their files, and playback that yields the same signals bit for bit."""

import dataclasses
import json
import sys

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
        user=7, position_m=rng.normal(size=3), stamp_ns=1_700_000_000_000_000_001)


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
