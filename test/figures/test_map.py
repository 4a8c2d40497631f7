"""The maps: averages in squares, and the command with jobs replaced."""

import json

import numpy as np
import pytest

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.experiments import sweep
from rhs_isac_ros.model import Scenario

pytest.importorskip('joblib')
pytest.importorskip('matplotlib')


@pytest.fixture(scope='module')
def figure(load_figure):
    return load_figure('map')


def test_values_are_averaged_in_squares(figure):
    positions = np.array([[5.1, -4.9, 0], [5.2, -4.8, 0.5], [14.9, 4.9, 0]])
    means = figure.mean_map(Scenario(), positions, np.array([1.0, 3.0, 5.0]))
    assert means.shape == (figure.SQUARES, figure.SQUARES)
    assert (means[0, 0], means[-1, -1]) == (2.0, 5.0)
    assert np.isnan(means).sum() == figure.SQUARES**2 - 2


def test_all_maps_share_one_scale_with_a_unit(figure):
    rng = np.random.default_rng(0)
    own = {key: rng.uniform(0.01, 4.0, (figure.SQUARES, figure.SQUARES)) for key in figure.TITLES}
    maps = {name: own | {'corners': Scenario().roi_bounds_m[:, :2]} for name in ('one', 'other')}
    *panels, bar = figure.picture(maps).axes
    assert [axes.get_title() for axes in panels[:3]] == list(figure.TITLES.values())
    assert [axes.get_ylabel() for axes in panels[::3]] == ['one\n$y$ [m]', 'other\n$y$ [m]']
    assert bar.get_ylabel() == 'error or bound [m]'
    assert len({axes.images[0].get_clim() for axes in panels}) == 1
    assert panels[0].images[0].get_extent() == [5, 15, -5, 5]


@pytest.mark.slow
def test_the_command_maps_each_plan(figure, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sweep, 'design', lambda scenario, **_: random_codebook(
        Scenario(**scenario), np.random.default_rng(0)).to_parameters())
    monkeypatch.setattr(sweep, 'evaluate', lambda n, **_: {'squared_error_m2': [0.25] * n})
    monkeypatch.setattr(figure, 'bound_map', lambda scenario, codebook, phases: {
        key: np.full((figure.SQUARES, figure.SQUARES), 0.04).tolist()
        for key in ('crlb', 'bound')})
    assert figure.main(['--quick', '--jobs', '1', '--output', str(tmp_path)]) == 0
    assert '0.2 to 0.2' in capsys.readouterr().out
    written = json.loads((tmp_path / 'map.json').read_text(encoding='utf-8'))
    assert len(written['maps_m2']) == 3
    errors = np.array(written['maps_m2']['4 unequally spaced']['error'])
    assert np.all(errors[np.isfinite(errors)] == 0.25)
    assert (tmp_path / 'map.png').stat().st_size > 10_000
