"""Gain patterns and their effect on the model."""

import dataclasses
import itertools
import pickle

import numpy as np
import pytest
from scipy.integrate import dblquad

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import directional_codebook
from rhs_isac_ros.link import capacity, steer
from rhs_isac_ros.model import (
    SPEED_OF_LIGHT_MPS,
    GainPattern,
    Scenario,
    ScenarioError,
)
from rhs_isac_ros.model.gain_pattern import PatternError
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.model.los import los_and_derivative, los_gain
from rhs_isac_ros.model.multipath import mean_los_power, multipath_covariance
from rhs_isac_ros.support import plugins


def patch(angles):
    """One smooth lobe in front, and no gain behind."""
    return 2 * np.maximum(np.cos(angles), 0)**3


def ripple(angles):
    return 1.2 + 0.5 * np.cos(4 * angles)


def ripple_slope(angles):
    return -2 * np.sin(4 * angles)


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    """The region is near and wide, so that angles differ between the elements."""
    return Scenario(n_subbands=3, n_frames=2, elements_per_side=4, element_gain=patch,
                    user_gain=GainPattern(ripple, ripple_slope), roi_center_m=(2, 0, 0),
                    roi_size_m=(2, 3, 2))


@pytest.fixture(scope='module')
def codebook(scenario, random_beams):
    return random_beams(scenario, np.random.default_rng(3))


def test_gains_match_the_definition(scenario):
    positions = scenario.sample_positions(3, np.random.default_rng(0))
    elements = element_positions(scenario)
    for band in range(scenario.n_bands):
        gains = los_gain(scenario, positions, band)
        for n, j, m in itertools.product(range(3), range(3), range(16)):
            offset = positions[n] - elements[m]
            distance = np.sqrt(offset @ offset)
            angle = np.arccos(offset[0] / distance)
            frequency = subband_frequencies_hz(scenario)[band, j]
            wavelength = SPEED_OF_LIGHT_MPS / frequency
            expected = (patch(angle) * ripple(angle) * wavelength / (4 * np.pi * distance)
                        * np.exp(-2j * np.pi * distance / wavelength))
            np.testing.assert_allclose(gains[n, j, m], expected, rtol=1e-10)


@pytest.mark.parametrize('user_gain', [1.0, GainPattern(ripple, ripple_slope), ripple])
def test_derivatives_are_limits_of_differences(scenario, user_gain):
    scenario = dataclasses.replace(scenario, user_gain=user_gain)
    positions = scenario.sample_positions(20, np.random.default_rng(1))
    step = 1e-5
    for band in range(scenario.n_bands):
        _, slopes = los_and_derivative(scenario, positions, band)
        for u in range(3):
            shift = step * np.eye(3)[u]
            difference = (los_gain(scenario, positions + shift, band)
                          - los_gain(scenario, positions - shift, band)) / (2 * step)
            np.testing.assert_allclose(
                slopes[:, u], difference, rtol=0, atol=1e-7 * np.abs(slopes).max())


def test_numerical_slopes_are_accurate_to_ten_digits():
    angles = np.linspace(0, np.pi, 1001)
    np.testing.assert_allclose(
        GainPattern(ripple).slope(angles), ripple_slope(angles), rtol=0, atol=1e-10)
    np.testing.assert_array_equal(
        GainPattern(ripple, ripple_slope).slope(angles), ripple_slope(angles))


def test_covariance_of_the_multipath_is_the_integral(scenario):
    """Eq. (2) for two elements by adaptive quadrature, with a weighted profile."""
    band, first, second = 1, 0, 7
    spread = np.deg2rad(scenario.angular_spread_deg)
    wavenumber = 2 * np.pi * scenario.center_frequencies_hz[band] / SPEED_OF_LIGHT_MPS
    offset = np.subtract(*element_positions(scenario)[[first, second]])

    def weight(azimuth, elevation):
        return np.exp(-np.sqrt(2) * (abs(azimuth) + abs(elevation)) / spread)

    def integrand(azimuth, elevation):
        direction = np.array([np.cos(elevation) * np.cos(azimuth),
                           np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        return (weight(azimuth, elevation) * patch(np.arccos(direction[0]))**2
                * np.cos(wavenumber * offset @ direction))

    def integral(function):
        # Split at 0, where the profile has a cusp.
        ends = ((-np.pi / 2, 0), (0, np.pi / 2))
        return sum(dblquad(function, *a, *b, epsabs=1e-11, epsrel=1e-9)[0]
                   for a, b in itertools.product(ends, ends))
    expected = integral(integrand) / integral(weight) * mean_los_power(scenario, band)
    covariance = multipath_covariance(scenario)[band, first, second]
    np.testing.assert_allclose(covariance, expected, rtol=1e-6)


def test_mean_power_is_weighted_by_the_users_pattern(scenario):
    positions = scenario.sample_positions(400_000, np.random.default_rng(5))
    squares = np.sum(positions**2, axis=1)
    gains = ripple(np.arccos(positions[:, 0] / np.sqrt(squares)))
    wavelength = SPEED_OF_LIGHT_MPS / scenario.center_frequencies_hz[0]
    expected = np.mean((wavelength * gains / (4 * np.pi))**2 / squares)
    assert mean_los_power(scenario, 0) == pytest.approx(expected, rel=3e-3)


def test_at_a_null_of_the_pattern_only_the_multipath_remains(scenario, codebook):
    """The bound is infinite there, and beams use the multipath."""
    blind = dataclasses.replace(scenario, user_gain=1.0, element_gain=lambda angles: np.where(
        angles < 0.4, 1 + np.cos(angles * np.pi / 0.4), 0.0))
    places = np.array([[1.1, 1.4, 0.9], [2.0, 0.1, 0.0]])
    bounds = crlb(blind, codebook, places)
    assert np.isinf(bounds[0])
    assert np.isfinite(bounds[1])
    rates = capacity(blind, steer(blind, places[0]), places)
    assert (rates > 0).all()
    with pytest.raises(ValueError, match=r'element_gain, user_gain: no gain at \[2.0, .*\] m'):
        directional_codebook(blind)


class TestIdentity:
    """Equality and hashes of patterns, and of scenarios with patterns."""

    def test_patterns_with_the_same_gains_are_equal(self):
        twin = GainPattern(lambda angles: patch(angles))
        assert twin == GainPattern(patch)
        assert hash(twin) == hash(GainPattern(patch))
        assert Scenario(element_gain=patch) == Scenario(element_gain=twin)
        assert hash(Scenario(element_gain=patch)) == hash(Scenario(element_gain=twin))
        other = GainPattern(lambda angles: 1.0001 * patch(angles))
        assert other != twin
        assert Scenario(element_gain=other) != Scenario(element_gain=twin)
        assert GainPattern(ripple) != GainPattern(ripple, ripple_slope)
        assert twin != 1.0

    def test_a_pattern_with_a_function_of_a_module_can_be_pickled(self):
        copy = pickle.loads(pickle.dumps(GainPattern(np.cosh)))
        assert copy == GainPattern(np.cosh)
        np.testing.assert_array_equal(copy.amplitude(np.ones(2)), np.cosh(np.ones(2)))


class TestPlugins:
    """Patterns by name."""

    CODE = '''
import numpy as np
from rhs_isac_ros.model import GainPattern

def patch(angles):
    return 2 * np.maximum(np.cos(angles), 0)**3

sharp = GainPattern(lambda angles: np.exp(-angles**2), lambda a: -2 * a * np.exp(-a**2))
number = 3.0

def short(angles):
    return angles[:1]

def minus(angles):
    return np.cos(angles)

def complex_(angles):
    return np.exp(1j * angles)

def none(angles):
    return np.maximum(np.cos(angles + np.pi), 0) - 0 * angles

def broken(angles):
    raise KeyError('table')
'''

    @pytest.fixture(autouse=True)
    def installed(self, install):
        names = ('sharp', 'number', 'short', 'minus', 'complex_', 'none', 'broken')
        install('antennas', self.CODE, {plugins.GAIN_PATTERNS: {
            'panel': 'patch', **{name: name for name in names}}})

    @pytest.mark.slow
    def test_a_file_may_name_a_pattern(self, tmp_path):
        (tmp_path / 'my.yaml').write_text('element_gain: panel\nuser_gain: sharp\n')
        scenario = Scenario.from_yaml(tmp_path / 'my.yaml')
        assert scenario.element_gain == GainPattern(patch)
        np.testing.assert_allclose(scenario.user_gain.slope(np.array([0.5])), -np.exp(-0.25))
        assert Scenario(**scenario.changes()) == scenario
        assert scenario.changes()['element_gain'] == f'panel@{GainPattern(patch).digest}'

    def test_a_pattern_with_another_digest_is_an_error(self):
        with pytest.raises(ScenarioError, match=(
                r'element_gain: panel: digest \w+, expected 0123456789abcdef: the content has '
                'changed')):
            Scenario(element_gain='panel@0123456789abcdef')

    @pytest.mark.parametrize(('name', 'words'), [
        ('absent', r"'absent', expected a plug-in of .*; installed: broken, complex_, minus"),
        ('number', r'antennas:number of antennas: 3.0: TypeError'),
        ('short', r'antennas:short .*: shape \(1,\), expected \[4097\]'),
        ('complex_', r'antennas:complex_ .*: complex numbers, expected real numbers \[4097\]'),
        ('minus', r'antennas:minus .* gain -0.000\d+ at 1.572 rad, expected 0 to 1e\+06'),
        ('none', r'antennas:none .* gain 0 at all angles below pi/2'),
        ('broken', r"antennas:broken .* KeyError: 'table', expected a function of an array"),
    ])
    def test_the_error_for_an_invalid_pattern_names_it(self, name, words):
        with pytest.raises(ScenarioError, match=f'user_gain: .*{words}'):
            Scenario(user_gain=name)


@pytest.mark.parametrize('gain', [-1.0, 2e6])
def test_gains_out_of_range_are_errors(gain):
    with pytest.raises(PatternError, match=f'gain {gain:g} at 0.000 rad'.replace('+', r'\+')):
        GainPattern(lambda angles: np.full(angles.shape, gain))


def test_a_pattern_may_be_positive_just_above_the_surface_alone():
    GainPattern(lambda angles: np.where((1.3 < angles) & (angles < 1.5), 1.0, 0.0))
