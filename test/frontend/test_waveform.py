"""OFDM pilots: synchronisation, sub-bands and noise, compared with theory."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.frontend import Air, Waveform, WaveformRadio
from rhs_isac_ros.frontend.waveform import N_SYMBOLS
from rhs_isac_ros.model import Scenario, ScenarioError

LAB = Scenario(
    n_frames=16, frame_duration_s=0.015, n_feeds=2, band_phase_std_rad=6.2832,
    timing_std_s=1e-7, roi_center_m=(4, 0, 0), roi_size_m=(4, 4, 1))
# Bands whose channels have other delays, as those of two multipath profiles.
DELAYS_S = np.array([0.2e-6, 0.9e-6])
RNG_SEED = 5


def response(scenario, delay_s, rng):
    """Return random signals of unit power with a common delay, complex128 [F, N_SB, K]."""
    offsets_hz = (np.arange(scenario.n_subbands) - (scenario.n_subbands - 1) / 2) * 125e3
    phases = np.exp(2j * np.pi * rng.random((scenario.n_frames, 1, scenario.n_feeds)))
    return phases * np.exp(-2j * np.pi * offsets_hz * delay_s)[:, None]


def with_snr(scenario, snr_db):
    """Return a scenario whose sub-bands of unit power have an SNR at a feed."""
    plain = 10 * np.log10(scenario.noise_power_w * scenario.n_subbands / scenario.max_power_w)
    return dataclasses.replace(
        scenario, noise_psd_dbm_hz=scenario.noise_psd_dbm_hz - snr_db - plain)


def captured(radio, signals, symbols=None):
    """Return the captures of the frames of a band."""
    symbols = np.ones(len(signals)) if symbols is None else symbols
    captures = []
    for radio.air.signals, symbol in zip(signals, symbols, strict=True):
        captures.append(radio.capture(0, radio.modem.pilot(symbol)))
    return np.stack(captures)


def radio_of(scenario, rng, **options):
    air = Air(scenario, rng)
    radio = WaveformRadio(scenario, air, **options)
    radio.air = air
    return radio


LAB_60_DB = with_snr(LAB, 60)


def received(radio, captures, cycle_id=1, symbols=1.0, band=0, times_s=0.0):
    return radio.modem.receive(cycle_id, captures, np.broadcast_to(symbols, 16), band,
                               np.broadcast_to(times_s, 16))


def to_db(power):
    return 10 * np.log10(power)


def without_phase_and_delay(found, signals, width_hz=125e3):
    """Divide by the common phase and the delay that a blind receiver cannot know."""
    ratio = found / signals
    offsets = np.arange(ratio.shape[1]) - (ratio.shape[1] - 1) / 2
    slope = np.angle(np.sum(ratio[:, 1:] * np.conj(ratio[:, :-1])))
    ratio = ratio * np.exp(-1j * slope * offsets)[:, None]
    return signals * ratio * np.exp(-1j * np.angle(ratio.sum()))


@pytest.mark.parametrize('snr_db', [20, 40])
@pytest.mark.parametrize('n_subbands', [8, 5])
def test_errors_and_measured_noise_are_those_of_theory(snr_db, n_subbands):
    scenario, rng = dataclasses.replace(LAB, n_subbands=n_subbands), np.random.default_rng(0)
    errors, noise, carriers = [], [], []
    for cycle_id in range(40):
        signals = response(scenario, 0.3e-6, rng)
        radio = radio_of(with_snr(scenario, snr_db), rng)
        found = received(radio, captured(radio, signals), cycle_id)
        errors.append(np.mean(np.abs(without_phase_and_delay(found, signals) - signals)**2))
        noise.append(radio.modem.noise_power)
        carriers.append(radio.modem.synchronisation.carrier_hz - radio._offsets[1])
    assert to_db(np.mean(errors)) == pytest.approx(-snr_db, abs=0.2)
    assert to_db(np.mean(noise)) == pytest.approx(-snr_db, abs=0.2)
    # The phase from the first to the last of four symbols, over all frames, feeds and sub-bands.
    phase_rad = np.sqrt(N_SYMBOLS * 10 ** (-snr_db / 10) / (16 * 2 * n_subbands)) / 3
    assert np.sqrt(np.mean(np.square(carriers))) == pytest.approx(
        phase_rad * 125e3 / (2 * np.pi), rel=0.3)


def test_the_difference_of_the_delays_of_two_bands_survives():
    """It contains the range; it would vanish if the timing was estimated for each band."""
    rng = np.random.default_rng(RNG_SEED)
    first, second = (response(LAB, delay_s, rng) for delay_s in DELAYS_S)
    radio, slopes = radio_of(LAB_60_DB, rng), []
    for signals in first, second:
        found = received(radio, captured(radio, signals), 7)
        slopes.append(np.angle(np.sum(found[:, 1:] * np.conj(found[:, :-1]))))
    delays_s = -np.array(slopes) / (2 * np.pi * 125e3)
    assert delays_s[1] - delays_s[0] == pytest.approx(np.diff(DELAYS_S)[0], abs=5e-9)
    assert abs(delays_s[0]) < 5e-9


def test_the_next_cycle_is_synchronised_again():
    rng = np.random.default_rng(RNG_SEED)
    signals = response(LAB, 0.2e-6, rng)
    radio = radio_of(LAB_60_DB, rng)
    assert radio.modem.status() == {}
    received(radio, captured(radio, signals), 7)
    first = radio.modem.synchronisation
    assert float(radio.modem.status()['radio.carrier_hz']) == pytest.approx(
        radio._offsets[1], abs=5)
    radio.close()
    received(radio, captured(radio, signals), 8)
    assert radio.modem.synchronisation != first


@pytest.mark.parametrize('scale', [0.0, 1e-3, 1e3])
def test_a_band_without_frames_does_not_synchronise_its_cycle(scale):
    """Those of the next band do, and it is used for all later ones."""
    rng = np.random.default_rng(RNG_SEED)
    signals = response(LAB, 0.2e-6, rng)
    radio = radio_of(LAB_60_DB, rng)
    captures = captured(radio, signals)
    received(radio, scale * (rng.normal(size=(*captures.shape, 2)) @ [1, 1j]), 7)
    assert not radio.modem.synchronisation.stands_out and radio.modem.status() == {}
    found = received(radio, captures, 7)
    np.testing.assert_allclose(without_phase_and_delay(found, signals), signals, atol=0.01)
    synchronisation = radio.modem.synchronisation
    received(radio, 0 * captures, 7)
    received(radio, captures, 7)
    assert radio.modem.synchronisation is synchronisation and synchronisation.stands_out


@pytest.mark.parametrize('clock_ppm', [0.0, 0.1, -2.0])
def test_the_drift_of_two_clocks_is_turned_back_in_all_bands(clock_ppm):
    scenario = dataclasses.replace(LAB, center_frequencies_hz=(5.25e9, 5.75e9))
    rng = np.random.default_rng(RNG_SEED)
    radio, ratios = radio_of(scenario, rng, clock_ppm=clock_ppm), []
    for band in range(2):
        signals, captures, times_s = response(scenario, 0.2e-6, rng), [], []
        for radio.air.frame, radio.air.signals in enumerate(signals):
            captures.append(radio.capture(band, radio.modem.pilot(1.0)))
            times_s.append(radio.time_s)
        ratio = received(radio, np.stack(captures), band=band, times_s=times_s) / signals
        ratios.append(ratio / ratio[0, 0, 0])
    # One phase and one delay remain unknown, and only the phase differs between the bands.
    expected = np.broadcast_to(ratios[0][0, :, :1], ratios[0].shape)
    np.testing.assert_allclose(ratios, [expected, expected], atol=0.05)


def test_a_clock_is_a_number():
    with pytest.raises(ValueError, match="clock_ppm: 'x'"):
        WaveformRadio(LAB, Air(LAB, np.random.default_rng(0)), clock_ppm='x')


def test_a_pilot_is_a_prefix_and_equal_symbols_of_alternating_sign():
    modem = Waveform(LAB)
    pilot = modem.pilot(2j)
    assert modem.sample_rate_hz == 2e6
    assert (modem.n_prefix, modem.n_period, len(pilot)) == (4, 16, 4 + 4 * 16)
    symbols = pilot[4:].reshape(N_SYMBOLS, 16)
    np.testing.assert_allclose(symbols, symbols[:1] * np.array([[1], [-1], [1], [-1]]), atol=1e-12)
    np.testing.assert_allclose(pilot[:4], -symbols[0, -4:], atol=1e-12)
    # One tone of amplitude 2 in each sub-band, and a low crest factor.
    power = np.abs(pilot)**2
    assert power[4:20].mean() == pytest.approx(8 * 4)
    assert power.max() < 2 * power.mean()


@pytest.mark.parametrize(('changes', 'text'), [
    ({'frame_duration_s': 3e-5}, 'frame_duration_s: 3e-05 s, expected at least 3.4e-05 s'),
    ({'timing_std_s': 1e-8}, r'timing_std_s: 1e-08 s, expected at least 2.11\d+e-08 s'),
    ({'band_phase_std_rad': 0.0}, 'band_phase_std_rad: 0 rad, expected at least 6.2832 rad')])
def test_a_scenario_that_is_no_waveform_is_refused(changes, text):
    Waveform(LAB)
    with pytest.raises(ScenarioError, match=text):
        Waveform(dataclasses.replace(LAB, **changes))
    with pytest.raises(ScenarioError, match='frame_duration_s: 4e-06 s, expected at least'):
        Waveform(Scenario())


def test_too_few_samples_are_an_error():
    with pytest.raises(ValueError, match='captures: 67 samples, expected at least 68'):
        Waveform(LAB).synchronise(np.ones((16, 2, 67)))
