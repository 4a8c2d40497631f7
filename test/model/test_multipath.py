"""The multipath: covariance, correlations and random gains."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import dblquad, tplquad

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model import multipath as mp


def test_covariance_matches_the_vectors(case):
    covariance = mp.multipath_covariance(case.scenario)
    assert covariance.shape == case.vectors['V'].shape
    np.testing.assert_allclose(covariance, case.vectors['V'], rtol=1e-6)
    assert not covariance.flags.writeable


@pytest.fixture(scope='module')
def other() -> Scenario:
    """A scenario whose gains, spread and region all differ from Table I."""
    return Scenario(
        center_frequencies_hz=(1.5e9, 4e9), elements_per_side=3, element_gain=2.0, user_gain=0.5,
        angular_spread_deg=25.0, roi_center_m=(3, 1, -1), roi_size_m=(4, 2, 3))


def mean_inverse_square(scenario: Scenario) -> float:
    low, high = np.array(scenario.roi_center_m) + np.outer([-0.5, 0.5], scenario.roi_size_m)
    bounds = [value for pair in zip(low, high, strict=True) for value in pair]
    total, _ = tplquad(lambda z, y, x: 1 / (x * x + y * y + z * z), *bounds, epsrel=1e-9)
    return total / np.prod(scenario.roi_size_m)


@pytest.mark.parametrize('band', [0, 1])
def test_mean_los_power_is_the_adaptive_integral(other, band):
    factor = 299_792_458 * 0.5 / (4 * np.pi * other.center_frequencies_hz[band])
    expected = factor**2 * mean_inverse_square(other)
    assert mp.mean_los_power(other, band) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(('band', 'm', 'n'), [(0, 0, 8), (1, 0, 1), (1, 7, 3), (1, 2, 6)])
@pytest.mark.parametrize('direction', [(0.0, 0.0), (40.0, 0.0), (0.0, -25.0), (-60.0, 80.0)])
def test_covariance_is_the_adaptive_integral(other, plain, direction, band, m, n):
    """Integrate each quadrant separately, because the profile has a cusp at its mean."""
    other = dataclasses.replace(other, multipath_direction_deg=direction)
    p = plain(other)
    wavenumber = 2 * np.pi * other.center_frequencies_hz[band] / 299_792_458
    offset = wavenumber * (p.element(m) - p.element(n))
    rate = np.sqrt(2) / np.deg2rad(25.0)
    middle = np.deg2rad(direction)

    def density(elevation, azimuth):
        return np.exp(-rate * (abs(azimuth - middle[0]) + abs(elevation - middle[1])))

    def phase(elevation, azimuth):
        return offset @ (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                         np.sin(elevation))

    def integral(function):
        azimuths, elevations = (((-np.pi / 2, one), (one, np.pi / 2)) for one in middle)
        return sum(dblquad(function, *a, *e, epsrel=1e-8, epsabs=1e-10)[0]
                   for a in azimuths for e in elevations)

    total = np.prod([
        (2 - np.exp(-rate * (np.pi / 2 - one)) - np.exp(-rate * (np.pi / 2 + one))) / rate
        for one in middle])
    real = integral(lambda *angles: np.cos(phase(*angles)) * density(*angles)) / total
    imag = integral(lambda *angles: np.sin(phase(*angles)) * density(*angles)) / total
    power = (299_792_458 / (4 * np.pi * other.center_frequencies_hz[band]))**2
    power *= mean_inverse_square(other) * 2.0**2 * 0.5**2
    np.testing.assert_allclose(
        mp.multipath_covariance(other)[band, m, n], power * (real + 1j * imag), rtol=1e-6)


@pytest.fixture(params=[(0.0, 0.0), (0.0, 40.0), (-60.0, 0.0), (30.0, -20.0)])
def rectangle(request) -> Scenario:
    """A rectangular surface, with the multipath from boresight and from elsewhere."""
    return Scenario(elements_per_side=(4, 7), multipath_direction_deg=request.param,
                    n_subbands=2, n_frames=1)


def products(scenario: Scenario, weights: np.ndarray) -> list[np.ndarray]:
    spatial = mp.spatial_covariance(scenario)
    return [spatial.scatter(weights), spatial[1].scatter(weights[1])[None],
            spatial[[1, 0]].scatter(weights[::-1])]


def assert_products(scenario: Scenario) -> None:
    weights = np.random.default_rng(0).normal(size=(2, 3, 5, 28, 2)) @ [1, 1j]
    expected = np.einsum('bfkm,bmn->bfkn', weights, mp.multipath_covariance(scenario))
    for found, wanted in zip(
            products(scenario, weights), (expected, expected[1:], expected[::-1]), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-13 * np.abs(expected).max())


def test_products_are_those_with_the_covariance(rectangle):
    assert mp.spatial_covariance(rectangle).matrix is not None
    assert_products(rectangle)


def test_products_with_many_elements_are_convolutions(rectangle, by_convolution):
    assert mp.spatial_covariance(rectangle).matrix is None
    assert_products(rectangle)


@pytest.mark.parametrize('rectangle', [(0.0, 0.0), (30.0, -20.0)], indirect=True)
def test_many_gains_are_drawn_as_plane_waves(rectangle, by_convolution, monkeypatch):
    monkeypatch.setattr(mp, '_WAVE_NODES', 16)
    n, v = 4000, mp.multipath_covariance(rectangle)[1]
    gains = mp.draw_multipath(rectangle, 1, n, np.random.default_rng(2))
    assert gains.shape == (n, 2, 28)
    for row in (0, 1):
        assert_sample_covariance(gains[:, row], gains[:, row], v, v[0, 0].real)
        assert_sample_covariance(gains[:, row], gains[:, row].conj(), 0, v[0, 0].real * 2**0.5)
    correlation = mp.measurement_correlation(rectangle)[1, 0, 1]
    assert_sample_covariance(gains[:, 0], gains[:, 1], correlation * v, v[0, 0].real)


def test_the_quadrature_resolves_large_surfaces(monkeypatch):
    """Twice as many nodes change nothing, even at an aperture of a hundred wavelengths."""
    scenario = Scenario(elements_per_side=(16, 1), element_interval_wavelengths=8.0,
                        angular_spread_deg=30.0)
    found = mp.multipath_covariance(scenario)
    monkeypatch.setattr(mp, '_ANGLE_NODES', 320)
    mp._lattice.cache_clear()
    finer = mp.multipath_covariance(scenario)
    mp._lattice.cache_clear()
    np.testing.assert_allclose(found, finer, atol=1e-10 * finer[0, 0, 0].real)


def test_two_intervals_are_those_of_the_elements(small):
    """Every other row of a denser lattice."""
    dense = dataclasses.replace(small.scenario, elements_per_side=(3, 5))
    sparse = dataclasses.replace(
        small.scenario, elements_per_side=3, element_interval_wavelengths=(0.3, 0.6))
    chosen = np.flatnonzero(np.arange(15) // 3 % 2 == 0)
    np.testing.assert_allclose(
        mp.multipath_covariance(sparse)[0],
        mp.multipath_covariance(dense)[0][np.ix_(chosen, chosen)], rtol=1e-9)


@pytest.fixture(scope='module')
def fading() -> Scenario:
    """A small scenario whose sub-bands and frames have correlations of about one half."""
    return Scenario(
        center_frequencies_hz=(2.5e9, 4e9), n_subbands=2, n_frames=3, elements_per_side=2,
        subband_width_hz=3e5, frame_duration_s=4e-3, angular_spread_deg=60.0)


def test_correlations_match_the_definition_when_they_are_low(fading, plain):
    p = plain(fading)
    for band in range(2):
        for a in range(3):
            for b in range(3):
                found = mp.time_correlation(fading, (a - b) * fading.frame_duration_s)[band]
                assert found == pytest.approx(p.rho_t(band, a, b), abs=1e-12)
        for a in range(2):
            for b in range(2):
                found = mp.frequency_correlation(fading, (a - b) * fading.subband_width_hz)
                assert found == pytest.approx(p.rho_f(band, a, b), rel=1e-12)
    assert abs(p.rho_t(1, 0, 2)) < 0.6
    assert abs(p.rho_f(0, 0, 1)) < 0.8


def test_measurement_correlation_is_the_kronecker_product_of_the_vectors(case):
    correlation = mp.measurement_correlation(case.scenario)
    for band, (over_f, over_t) in enumerate(
            zip(case.vectors['K_f'], case.vectors['K_t'], strict=True)):
        np.testing.assert_allclose(correlation[band], np.kron(over_f, over_t), rtol=1e-8)
    assert not correlation.flags.writeable


def test_factors_square_to_the_covariances(case):
    """They lack eigenvalues below 1e-10 of the largest one."""
    factors = mp.multipath_factors(case.scenario)
    for band, factors_of_band in enumerate(factors):
        over_f, over_t = case.vectors['K_f'][band], case.vectors['K_t'][band]
        for factor, expected in zip(
                factors_of_band, (case.vectors['V'][band], np.kron(over_f, over_t)), strict=True):
            np.testing.assert_allclose(factor @ factor.conj().T, expected, rtol=0,
                                       atol=1e-10 * np.linalg.norm(expected, 2))


@pytest.mark.parametrize('scenario', [
    Scenario(), Scenario(multipath_direction_deg=(20.0, 5.0)), Scenario(delay_spread_s=1e-9)],
    ids=['even', 'uneven', 'flat'])
def test_rounding_changes_no_draw(scenario):
    """Eigenvectors have other phases, and equal eigenvalues other vectors, on other processors."""
    (matrix, *_), rng = mp.multipath_covariance(scenario), np.random.default_rng(0)
    expected = mp.drawing_root(matrix)
    nearly = matrix * (1 + 1e-14 * rng.normal(size=matrix.shape))
    np.testing.assert_allclose(
        mp.drawing_root((nearly + nearly.conj().T) / 2), expected,
        atol=1e-5 * np.abs(expected).max())
    turn = np.linalg.qr(mp.complex_normal((expected.shape[1],) * 2, rng))[0]
    np.testing.assert_allclose(
        mp.turned(expected @ turn), expected, atol=1e-9 * np.abs(expected).max())


N_DRAWS = 20_000
# Allowed deviation in standard deviations; a few hundred statistics are checked at once.
SIGMAS = 5.0


def assert_sample_covariance(first, second, expected, power):
    """Check E[first second^H] with both [n, ...] flattened, entries having that mean power."""
    n = len(first)
    sample = first.reshape(n, -1).T @ second.reshape(n, -1).conj() / n
    deviation = np.abs(sample - expected) / power
    assert deviation.max() < SIGMAS / np.sqrt(n)


def test_drawn_gains_have_the_covariance(fading, plain):
    p, rng = plain(fading), np.random.default_rng(2)
    first, second = (mp.draw_multipath(fading, band, N_DRAWS, rng) for band in (0, 1))
    assert first.shape == (N_DRAWS, 6, 4)
    for band, gains in enumerate((first, second)):
        v = mp.multipath_covariance(fading)[band]
        expected = np.zeros((6, 4, 6, 4), complex)
        for a, (j1, q1) in enumerate(p.rows):
            for b, (j2, q2) in enumerate(p.rows):
                expected[a, :, b] = p.rho_f(band, j1, j2) * p.rho_t(band, q1, q2) * v
        assert_sample_covariance(gains, gains, expected.reshape(24, 24), v[0, 0].real)
        # Circular: the product without conjugate has mean zero; so has the gain.
        assert_sample_covariance(gains, gains.conj(), 0, v[0, 0].real * np.sqrt(2))
        deviation = np.abs(gains.mean(axis=0)) / np.sqrt(v[0, 0].real)
        assert deviation.max() < SIGMAS / np.sqrt(N_DRAWS)
    # Bands are independent.
    power = np.sqrt(np.prod([np.mean(np.abs(gains)**2) for gains in (first, second)]))
    assert_sample_covariance(first, second, 0, power)


def test_complex_normal_is_circular_with_unit_variance():
    n = 200_000
    z = mp.complex_normal((n // 4, 4), np.random.default_rng(3)).ravel()
    assert z.shape == (n,)
    assert np.mean(np.abs(z)**2) == pytest.approx(1, abs=SIGMAS / np.sqrt(n))
    assert abs(np.mean(z)) < SIGMAS / np.sqrt(n)
    assert abs(np.mean(z * z)) < SIGMAS * np.sqrt(2 / n)
    # The fourth moment is characteristic of the normal distribution.
    assert np.mean(np.abs(z)**4) == pytest.approx(2, abs=SIGMAS * np.sqrt(20 / n))
    # Successive numbers are independent.
    assert abs(np.mean(z[1:] * z[:-1].conj())) < SIGMAS / np.sqrt(n)
