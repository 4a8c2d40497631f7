"""Codebooks without optimisation: the random one, and beams that scan the region."""

import numpy as np
import pytest

from rhs_isac_ros.codebook import directional_codebook, random_codebook
from rhs_isac_ros.codebook.unoptimised import SCANS, width_points
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate

SCENARIOS = [
    Scenario(max_power_w=0.3),
    Scenario(center_frequencies_hz=(2e9, 2.3e9, 3.1e9), elements_per_side=16, n_subbands=2,
             n_frames=3, roi_center_m=(8, 3, 1), roi_size_m=(4, 12, 3)),
    Scenario(center_frequencies_hz=(2.5e9,), n_feeds=1, n_subbands=1, n_frames=1),
]


@pytest.mark.parametrize('scenario', SCENARIOS)
def test_constraints_hold_and_sub_bands_share_the_power_evenly(scenario):
    codebook = directional_codebook(scenario)
    codebook.check(scenario)
    assert codebook.analog.min() >= 0
    assert codebook.analog.max() <= 1
    power = np.sum(np.abs(codebook.digital)**2, axis=-1)
    np.testing.assert_allclose(power, scenario.max_power_w / scenario.n_subbands, rtol=1e-12)
    assert codebook.provenance == 'directional'


@pytest.mark.parametrize('scan', ['width_per_band', 'grid'])
@pytest.mark.parametrize('scenario', SCENARIOS)
def test_the_other_scans_have_the_same_points_in_each_band(scenario, scan):
    points = SCANS[scan](scenario)
    low, high = scenario.roi_bounds_m
    assert points.shape == (scenario.n_frames, scenario.n_bands, 3)
    assert ((points > low) & (points < high)).all()
    assert (points == points[:, :1]).all()
    assert len(np.unique(points[:, 0], axis=0)) == scenario.n_frames
    np.testing.assert_allclose(points[..., 0], scenario.roi_center_m[0])
    np.testing.assert_allclose(points[..., 1].mean(), scenario.roi_center_m[1], atol=1e-12)
    directional_codebook(scenario, scan=scan).check(scenario)


def test_the_grid_of_table_1_has_two_points_across_width_and_height():
    points = SCANS['grid'](Scenario())[:, 0, 1:]
    np.testing.assert_allclose(points, [[-2.5, -0.5], [2.5, -0.5], [-2.5, 0.5], [2.5, 0.5]])


def test_beams_are_focused_with_the_response_of_a_calibrated_surface():
    scenario = Scenario(n_frames=1)
    phases = np.exp(2j * np.pi * np.random.default_rng(0).uniform(size=100))
    surface = SurfaceEstimate(phases, 0.1 * phases, [1, 1], np.zeros((202, 0)), np.zeros(100))
    strength = []
    for known in (None, surface):
        codebook = directional_codebook(scenario, surface=known)
        model = MeasurementModel(scenario, codebook, surface)
        mean = np.stack([model.mean(points)[0, band]
                         for band, points in enumerate(np.swapaxes(width_points(scenario), 0, 1))])
        strength.append(np.abs(mean).mean())
    assert strength[1] > 2 * strength[0]
    # The combining vectors are matched filters, so that all sub-bands are in phase.
    np.testing.assert_allclose(np.angle(mean), 0, atol=1e-9)


def test_an_unknown_scan_is_an_error():
    with pytest.raises(ValueError, match="^scan: 'depth', expected one of "):
        directional_codebook(Scenario(), scan='depth')


@pytest.mark.parametrize('scenario', SCENARIOS)
def test_focal_points_scan_the_width_of_the_region(scenario):
    points = width_points(scenario)
    low, high = scenario.roi_bounds_m
    assert points.shape == (scenario.n_frames, scenario.n_bands, 3)
    assert ((points > low) & (points < high)).all()
    np.testing.assert_allclose(points[..., 0], scenario.roi_center_m[0])
    across = np.sort(points[..., 1].ravel())
    step = (high[1] - low[1]) / across.size
    np.testing.assert_allclose(across, low[1] + step * (np.arange(across.size) + 0.5))
    # Each band scans the whole width.
    assert (np.ptp(points[..., 1], axis=0) >= step * across.size * (
        1 - 1 / scenario.n_frames) - 1e-9).all()
    if scenario.n_frames > 1:
        heights = points[..., 2] - scenario.roi_center_m[2]
        assert (heights[::2] < 0).all()
        assert (heights[1::2] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize('scenario', SCENARIOS[:2])
def test_each_beam_is_nearly_strongest_at_its_focal_point(scenario, plain):
    """Compares the received power, without path loss, at all focal points."""
    codebook = directional_codebook(scenario)
    p = plain(scenario, codebook.analog, codebook.digital)
    points = width_points(scenario).reshape(-1, 3)
    for band in range(scenario.n_bands):
        mean = p.mean(points, band).reshape(len(points), scenario.n_subbands, -1)
        power = np.sum(np.abs(mean)**2, axis=1) * np.sum(points**2, axis=1, keepdims=True)
        for frame in range(scenario.n_frames):
            own = power[frame * scenario.n_bands + band, frame]
            assert own > 0.9 * power[:, frame].max()
            assert own > 2 * power[:, frame].mean()


@pytest.mark.parametrize('sides', [(24, 6), (6, 24)])
def test_the_beam_of_a_rectangle_is_narrow_along_its_long_side(sides):
    """The first of two numbers of elements is along y."""
    scenario = Scenario(center_frequencies_hz=(3e9,), n_frames=1, n_subbands=1,
                        elements_per_side=sides)
    model = MeasurementModel(scenario, directional_codebook(scenario))
    slopes, focus = np.linspace(-0.5, 0.5, 1001), width_points(scenario)[0, 0]
    widths = []
    for axis in (1, 2):
        points = np.tile(focus, (len(slopes), 1))
        points[:, axis] += focus[0] * slopes
        power = np.abs(model.mean(points)[:, 0, 0])**2
        widths.append(np.mean(power > power.max() / 2))
    assert widths[np.argmax(sides)] < 0.6 * widths[np.argmin(sides)]


def test_random_codebook_is_the_papers_start():
    scenario = Scenario(max_power_w=0.5, elements_per_side=30)
    codebook = random_codebook(scenario, np.random.default_rng(0))
    codebook.check(scenario)
    # K = 3 feeds and N_SB = 8 sub-bands share the power evenly.
    np.testing.assert_allclose(codebook.digital, np.sqrt(0.5 / 24), rtol=1e-12)
    # Uniform on [0, 1]: 7200 entries.
    ordered = np.sort(codebook.analog.ravel())
    assert np.abs(ordered - (np.arange(7200) + 0.5) / 7200).max() < 0.02
