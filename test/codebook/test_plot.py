"""The plot of an optimisation."""

import sys

import numpy as np
import pytest

from rhs_isac_ros.codebook import Progress, directional_codebook, plot
from rhs_isac_ros.codebook.directional import width_points
from rhs_isac_ros.codebook.plot import beam_powers, plot_optimization
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.optional import MissingLibraryError

HISTORY = [Progress(0, 1, 3.0, 0.1), Progress(1, 2, 1.0, 0.2)]


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    monkeypatch.setattr(plot, '_N_MAP_POINTS', 6)


@pytest.mark.parametrize('n_bands', [1, 2, 4])
def test_draws_any_number_of_bands(scenario, n_bands, tmp_path):
    pytest.importorskip('matplotlib')
    changed = Scenario(**scenario.changes() | {
        'center_frequencies_hz': [2.5e9 + 1e8 * i for i in range(n_bands)]})
    plot_optimization(changed, directional_codebook(changed), HISTORY, tmp_path / 'p.png')
    assert (tmp_path / 'p.png').read_bytes().startswith(b'\x89PNG')


def test_an_unknown_format_is_an_error(scenario, tmp_path):
    pytest.importorskip('matplotlib')
    with pytest.raises(ValueError, match='xyz'):
        plot_optimization(scenario, directional_codebook(scenario), HISTORY, tmp_path / 'p.xyz')
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_the_error_names_the_extra(scenario, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    with pytest.raises(
            MissingLibraryError, match='^plotting needs matplotlib, .*rhs_isac_ros.plot'):
        plot_optimization(scenario, directional_codebook(scenario), HISTORY, tmp_path / 'p.png')


def test_beams_point_at_their_width_points():
    scenario = Scenario()
    codebook, points = directional_codebook(scenario), width_points(scenario)
    for band in range(scenario.n_bands):
        azimuths, powers = beam_powers(scenario, codebook, band)
        assert powers.shape == (scenario.n_frames, len(azimuths))
        wanted = np.arctan2(points[:, band, 1], points[:, band, 0])
        np.testing.assert_allclose(azimuths[powers.argmax(axis=1)], wanted, atol=0.12)
