"""The picture of a sweep: panels, lines, scales and intervals."""

import numpy as np
import pytest

from rhs_isac_ros.experiments.resampling import Interval
from rhs_isac_ros.experiments.sweep import Point
from rhs_isac_ros.experiments.sweep_picture import draw, shown
from rhs_isac_ros.experiments.sweep_settings import parse_axis, settings_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.pictures import write_picture

pytest.importorskip('matplotlib')


def drawn(*texts, panels=(('mse',),), value=lambda point: 1.0, base=Scenario()):  # noqa: B008
    axes = [parse_axis(text) for text in texts]
    points = []
    for setting in settings_of(base, axes, 'optimize', 'bayes'):
        for measure in [name for panel in panels for name in panel]:
            number = value(setting.scenario)
            points.append(Point(setting, measure, Interval(number, 0.8 * number, 1.3 * number),
                                ()))
    return draw(axes, points, panels)


def panels_of(figure):
    return [axes for axes in figure.axes if axes.get_ylabel()]


def test_a_panel_for_each_measure_and_a_line_for_each_value():
    figure = drawn('n_frames=1,2,4', 'multipath_to_los_db=0,-10', panels=[['mse'], ['capacity']])
    left, right = panels_of(figure)
    assert left.get_ylabel() == 'mean squared error [m²]'
    assert right.get_ylabel() == 'capacity [bit/s]'
    assert left.get_xlabel() == 'frames $F$'
    assert left.get_xscale() == 'log'
    assert [tick.get_text() for tick in left.get_xticklabels()] == ['1', '2', '4']
    labels = [bars.get_label() for bars in left.containers]
    assert labels == ['−10', '0']
    (legend,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    assert legend.get_title().get_text() == (
        'multipath / direct path [dB]; bars: 95 % intervals')


def test_every_point_has_its_interval():
    (panel,) = panels_of(drawn('n_frames=1,2,3,4', value=lambda scenario: scenario.n_frames))
    (bars,) = panel.containers
    ends = [segment[:, 1].tolist() for segment in bars.lines[2][0].get_segments()]
    assert ends == [pytest.approx([0.8 * n, 1.3 * n]) for n in (1, 2, 3, 4)]
    assert panel.get_xscale() == 'linear'


def test_lines_differ_in_colour_marker_style_and_place():
    (panel,) = panels_of(drawn('n_frames=1,2', 'n_feeds=1,2,3'))
    looks = [(line.get_color(), line.get_marker(), line.get_linestyle(), line.get_xdata()[0])
             for line in (bars.lines[0] for bars in panel.containers)]
    assert all(len(set(values)) == 3 for values in zip(*looks, strict=True))


def test_measures_of_one_panel_differ_in_style():
    figure = drawn('n_frames=1,2', 'n_feeds=1,2', panels=[['rmse', 'root_crlb'], ['capacity']])
    panel, _ = panels_of(figure)
    assert len({bars.lines[0].get_linestyle() for bars in panel.containers}) == 2
    assert len({bars.lines[0].get_color() for bars in panel.containers}) == 2
    (legend,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    assert [text.get_text() for text in legend.get_texts()] == [
        '1', '2', 'root mean squared error', 'root of the average CRLB']
    # The markers of further measures are hollow, as in the panel.
    assert [line.get_markerfacecolor() for line in legend.get_lines()[-2:]] == ['0.4', 'white']


def test_further_fields_have_rows_of_panels():
    figure = drawn('n_frames=1,2', 'n_feeds=1,2', 'elements_per_side=4,6,8', 'n_subbands=1,2')
    titles = [panel.get_title() for panel in panels_of(figure)]
    assert len(titles) == 6
    assert titles[1] == r'elements along a side $\sqrt{N_\mathrm{E}}$: 4, sub-bands ' \
        r'$N_\mathrm{SB}$: 2'


@pytest.mark.parametrize(('measure', 'largest', 'scale', 'unit'), [
    ('capacity', 2e5, 'linear', 'kbit/s'), ('capacity', 1e6, 'linear', 'Mbit/s'),
    ('mse', 5, 'linear', 'm²'), ('mse', 1e4, 'log', 'm²')])
def test_capacities_have_a_prefix_and_errors_of_different_sizes_a_logarithmic_scale(
        measure, largest, scale, unit, tmp_path):
    figure = drawn('n_frames=1,2', panels=[[measure]],
                   value=lambda scenario: largest**(scenario.n_frames - 1))
    (panel,) = panels_of(figure)
    assert panel.get_ylabel().endswith(f' [{unit}]')
    assert panel.get_yscale() == scale
    write_picture(tmp_path / 'a.svg', figure)


@pytest.mark.slow
def test_infinite_and_missing_values_are_left_out(tmp_path):
    for number in (np.inf, np.nan):
        figure = drawn('n_frames=1,2,3', value=lambda scenario, number=number: (
            number if scenario.n_frames == 2 else 1.0))
        assert len(panels_of(figure)[0].containers[0].lines[0].get_xdata()) == 2
        write_picture(tmp_path / 'a.png', figure)
    write_picture(tmp_path / 'b.png', drawn('n_frames=1,2', value=lambda _: np.nan))


def test_an_interval_without_upper_end_has_an_arrow_to_the_edge(tmp_path):
    axes = [parse_axis('n_frames=1,2')]
    points = [Point(setting, 'crlb_p95', interval, ()) for setting, interval in zip(
        settings_of(Scenario(), axes, 'random', 'bayes'),
        (Interval(3.0, 2.0, np.inf), Interval(1.0, 0.8, 1.2)), strict=True)]
    figure = draw(axes, points, [['crlb_p95']])
    write_picture(tmp_path / 'a.png', figure)
    (panel,) = panels_of(figure)
    (arrow,) = panel.texts
    assert (arrow.xy[1], arrow.xyann[1]) == (1, 3.0)
    assert panel.get_ylim()[1] < 4


@pytest.mark.parametrize(('name', 'value', 'text'), [
    ('max_power_w', 1e-3, '0.001'), ('subband_width_hz', 125e3, '125000'),
    ('roi_center_m', (10.0, 0.0, 0.0), '[10.0, 0.0, 0.0]'), ('feed_positions_m', None, 'null')])
def test_texts_of_values(name, value, text):
    assert shown(name, value) == text
