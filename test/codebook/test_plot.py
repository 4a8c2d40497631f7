"""The plot of an optimisation."""

import sys

import numpy as np
import pytest

from rhs_isac_ros.codebook import Progress, directional_codebook
from rhs_isac_ros.codebook.plot import beam_powers, plot_optimization
from rhs_isac_ros.codebook.unoptimised import width_points
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.support.pictures import write_picture

HISTORY = [Progress(0, 1, 3.0, 0.1), Progress(1, 2, 1.0, 0.2)]


@pytest.mark.slow
def test_draws_a_single_band(scenario, tmp_path):
    pytest.importorskip('matplotlib')
    changed = Scenario(**scenario.changes() | {'center_frequencies_hz': [2.5e9]})
    write_picture(tmp_path / 'p.png', plot_optimization(
        changed, directional_codebook(changed), HISTORY))
    assert (tmp_path / 'p.png').read_bytes().startswith(b'\x89PNG')


def test_axes_have_units_and_the_beams_one_legend():
    pytest.importorskip('matplotlib')
    scenario = Scenario()
    figure = plot_optimization(scenario, directional_codebook(scenario), HISTORY)
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes]
    for expected in (('step', 'objective [m$^2$]'), ('$x$ [m]', '$y$ [m]'), ('', '√CRLB [m]'),
                     ('azimuth [°]', 'relative power [dB]')):
        assert expected in labels
    (legend,) = filter(None, [axes.get_legend() for axes in figure.axes])
    assert [text.get_text() for text in legend.get_texts()] == [
        f'frame {frame}' for frame in range(4)]
    (beams,) = [axes for axes in figure.axes if axes.get_title() == 'beams of band 0, 2.5 GHz']
    assert len({line.get_linestyle() for line in beams.lines}) == 4


def test_without_matplotlib_the_error_names_the_extra(scenario, monkeypatch):
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    with pytest.raises(
            MissingLibraryError, match='^plotting needs matplotlib, .*rhs_isac_ros.plot'):
        plot_optimization(scenario, directional_codebook(scenario), HISTORY)


def test_beams_point_at_their_width_points():
    scenario = Scenario()
    codebook, points = directional_codebook(scenario), width_points(scenario)
    for band in range(scenario.n_bands):
        azimuths, powers = beam_powers(scenario, codebook, band)
        assert powers.shape == (scenario.n_frames, len(azimuths))
        wanted = np.arctan2(points[:, band, 1], points[:, band, 0])
        np.testing.assert_allclose(azimuths[powers.argmax(axis=1)], wanted, atol=0.12)
