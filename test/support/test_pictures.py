"""Pictures: formats, equal files of repeated runs, style and looks."""

import os
import subprocess
import sys

import pytest

from rhs_isac_ros.support import pictures
from rhs_isac_ros.support.optional import MissingLibraryError

MAGIC = {'png': b'\x89PNG', 'pdf': b'%PDF', 'svg': b'<?xml'}
# Everything whose ids or order Matplotlib might draw at random.
DRAW = '''
import sys
from rhs_isac_ros.support.pictures import look, new_figure, paper_style, write_picture

with paper_style():
    figure = new_figure(3.5, 2.5)
    axes = figure.subplots()
    for index in range(3):
        axes.errorbar([1, 2, 3], [index, 2, 1], 0.3, marker=look(index).marker, label='äß²')
    axes.bar([1, 2], [1, 2], hatch='//', alpha=0.5)
    axes.imshow([[0, 1], [2, 3]])
    axes.set(xlabel=r'$N_\\mathrm{B}$', ylabel='√CRLB [m]', yscale='symlog')
    axes.legend()
for path in sys.argv[1:]:
    write_picture(path, figure)
'''


@pytest.fixture
def figure():
    pytest.importorskip('matplotlib')
    with pictures.paper_style():
        figure = pictures.new_figure(3.5, 2.5)
        figure.subplots().set(xlabel=r'$r_\mathrm{min}$ [m]')
        return figure


@pytest.mark.parametrize('kind', pictures.PICTURE_FORMATS)
def test_the_suffix_selects_the_format(figure, tmp_path, kind):
    pictures.write_picture(tmp_path / f'a.{kind.upper()}', figure)
    assert (tmp_path / f'a.{kind.upper()}').read_bytes().startswith(MAGIC[kind])


@pytest.mark.parametrize('name', ['a.gif', 'png'])
def test_another_suffix_is_an_error_and_leaves_no_file(figure, tmp_path, name):
    with pytest.raises(ValueError, match=f"{name}', expected a file name that ends in .png, .pdf"):
        pictures.write_picture(tmp_path / name, figure)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_processes_write_equal_files_whatever_their_hash_seed(tmp_path, monkeypatch):
    pytest.importorskip('matplotlib')
    for name in ('here', 'there'):
        (tmp_path / name).mkdir()
    files = [f'a.{kind}' for kind in pictures.PICTURE_FORMATS]
    monkeypatch.setattr(sys, 'argv', ['', *(str(tmp_path / 'here' / name) for name in files)])
    exec(DRAW, {})
    subprocess.run([sys.executable, '-c', DRAW, *files], check=True, timeout=240,
                   cwd=tmp_path / 'there', env=os.environ | {'PYTHONHASHSEED': '1'})
    for name in files:
        assert (tmp_path / 'here' / name).read_bytes() == (tmp_path / 'there' / name).read_bytes()


def test_the_style_replaces_the_settings_of_the_user_inside_the_block_only():
    matplotlib = pytest.importorskip('matplotlib')
    with matplotlib.rc_context({'font.size': 30.0, 'lines.linewidth': 9.0, 'axes.grid': True}):
        with pictures.paper_style():
            assert matplotlib.rcParams['font.size'] == 8.0
            assert not matplotlib.rcParams['axes.grid']
        assert matplotlib.rcParams['font.size'] == 30.0
        assert matplotlib.rcParams['axes.grid']


@pytest.mark.parametrize(('high', 'expected'), [
    (0.17, {'0.08', '0.1', '0.15'}), (7.0, {'0.1', '0.2', '0.5', '1', '2', '5'})])
def test_a_logarithmic_axis_has_labels_within_a_decade_and_beyond(high, expected):
    pytest.importorskip('matplotlib')
    with pictures.paper_style():
        axes = pictures.new_figure(3.5, 2.5).subplots()
        axes.semilogy([0, 1], [0.078, high])
        pictures.label_decades(axes.yaxis)
        low, top = axes.get_ylim()
        assert {text.get_text() for text in axes.get_yticklabels()
                if low <= text.get_position()[1] <= top} == expected


@pytest.mark.parametrize('shape', [(1, 2), (3, 1)])
def test_a_legend_above_the_panels_overlaps_none(shape):
    pytest.importorskip('matplotlib')
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    with pictures.paper_style():
        figure, panels, above = pictures.new_panels(7.0, 4.0, *shape, sharex=True)
        for axes in panels.flat:
            axes.plot([0, 1], label='a line')
            axes.set_title('title')
        legend = above.legend(*panels[0, 0].get_legend_handles_labels(), loc='lower center',
                              title='two\nlines')
        FigureCanvasAgg(figure).draw()
    assert panels.shape == shape
    box = legend.get_window_extent()
    assert figure.bbox.y1 >= box.y1
    assert all(axes.title.get_window_extent().y1 <= box.y0 for axes in panels[0])


def test_looks_differ_in_colour_marker_line_and_hatch():
    for attribute in zip(*pictures.LOOKS, strict=True):
        assert len(set(attribute)) == len(pictures.LOOKS)
    assert pictures.look(len(pictures.LOOKS)) == pictures.LOOKS[0]


def test_without_matplotlib_the_error_names_purpose_and_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    with pytest.raises(MissingLibraryError, match=r'^plotting needs matplotlib, .*ros\[plot\]'), \
            pictures.paper_style('plotting'):
        pass
