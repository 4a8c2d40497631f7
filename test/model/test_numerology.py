"""Grids of New Radio, and combs of pilots."""

import numpy as np
import pytest

from rhs_isac_ros.frontend import Waveform
from rhs_isac_ros.model import Scenario, ScenarioError, nr_grid
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import frequency_correlation, measurement_correlation

COMB = Scenario(center_frequencies_hz=(3.5e9,), **nr_grid(1, 4, 2, comb=4))


def test_a_grid_has_the_sub_carriers_and_symbols_of_its_numerology():
    grid = nr_grid(numerology=3, resource_blocks=66, symbols=12)
    assert grid['n_subbands'] * grid['subband_width_hz'] == 66 * 12 * 120e3
    assert grid['frame_duration_s'] * 14 * 8 == pytest.approx(1e-3)
    assert Scenario(center_frequencies_hz=(28e9,), **grid).n_frames == 12


def test_pilots_on_a_comb_have_the_noise_of_one_sub_carrier_and_the_span_of_the_comb():
    full = Scenario(center_frequencies_hz=(3.5e9,), **nr_grid(1, 4, 2))
    assert COMB.noise_power_w == full.noise_power_w
    assert COMB.bandwidth_hz == full.bandwidth_hz == 48 * 30e3
    np.testing.assert_allclose(np.diff(subband_frequencies_hz(COMB)), 4 * 30e3)


def test_signals_on_a_comb_are_those_at_its_frequencies():
    position = np.array([[8.0, 1.0, 0.5]])
    distances = np.linalg.norm(position - element_positions(COMB), axis=1)
    for frequency, gain in zip(subband_frequencies_hz(COMB)[0], los_gain(COMB, position, 0)[0],
                               strict=True):
        wavelength = 299_792_458 / frequency
        np.testing.assert_allclose(gain, wavelength / (4 * np.pi * distances) * np.exp(
            -2j * np.pi * distances / wavelength), rtol=1e-9)
    np.testing.assert_allclose(
        measurement_correlation(COMB)[0, 0, ::2],
        frequency_correlation(COMB, -120e3 * np.arange(12)), rtol=1e-9)


def test_a_scenario_file_may_declare_its_grid(tmp_path):
    file = tmp_path / 'nr.yaml'
    file.write_text('center_frequencies_hz: [3.5e9]\n'
                    'grid: {numerology: 1, resource_blocks: 4, symbols: 2, comb: 4}\n')
    assert Scenario.from_yaml(file) == COMB


@pytest.mark.parametrize(('text', 'words'), [
    ('{numerology: 7, resource_blocks: 4, symbols: 2}', 'numerology: 7, expected'),
    ('{numerology: 1, resource_blocks: 4, symbols: 2, comb: 5}', 'comb: 5, expected a divisor'),
    ('{numerology: 1.5, resource_blocks: 4, symbols: 2}', 'numerology: 1.5, expected'),
    ('{numerology: 1}', 'resource_blocks'), ('3', '')])
def test_other_grids_are_errors(tmp_path, text, words):
    (tmp_path / 'nr.yaml').write_text(f'grid: {text}\n')
    with pytest.raises(ScenarioError, match=f'nr.yaml: grid: .*{words}'):
        Scenario.from_yaml(tmp_path / 'nr.yaml')


def test_a_waveform_fills_the_band():
    with pytest.raises(ScenarioError, match='^subband_spacing_hz: 120000 Hz, expected 0'):
        Waveform(COMB)
