"""The entries of a view in a file of Rerun, read back with its own reader."""

import subprocess
import sys

import numpy as np
import pytest

from rhs_isac_ros.monitoring import network_view
from rhs_isac_ros.monitoring.shapes import (
    Boxes,
    Clear,
    Ellipsoids,
    Entry,
    Lines,
    Number,
    Picture,
    Points,
    Series,
    Text,
)
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.tools.rerun_stream import RerunStream, blueprint

rerun = pytest.importorskip('rerun', reason='rerun-sdk is not installed (scripts/setup view)')
PLACES = np.array([[9.0, 1.0, 0.5], [8.0, 2.0, 0.0]])
COLOURS = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
QUATERNIONS = np.array([[0.0, 0.0, 0.6, 0.8], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def read(tmp_path):
    """Function that writes entries to a file and returns the columns of a path by component."""
    def columns(path, *entities):
        stream = RerunStream()
        stream.save(tmp_path / 'view.rrd')
        stream.write(Entry(cycle, path, entity) for cycle, entity in enumerate(entities, 1))
        stream.close()
        assert [file.name for file in tmp_path.iterdir()] == ['view.rrd']
        recording = rerun.dataframe.load_recording(tmp_path / 'view.rrd')
        table = recording.view(index='cycle', contents=f'/{path}').select().read_all()
        return {name.rpartition(':')[2]: table[name].to_pylist()
                for name in table.column_names if not name.startswith('log_')}
    return columns


@pytest.mark.parametrize('n_coordinates', [2, 3])
def test_points_keep_position_colour_radius_and_label(read, n_coordinates):
    places = PLACES[:, :n_coordinates]
    found = read('a', Points(places, COLOURS, np.array([0.1, 0.2]), ('one', 'two')))
    assert found['cycle'] == [1]
    (positions,) = found[f'Position{n_coordinates}D']
    assert np.array(positions) == pytest.approx(places)
    assert found['Color'] == [[0xff0080ff, 0x00ff00ff]]
    assert found['Radius'] == [pytest.approx([0.1, 0.2])]
    assert found['Text'] == [['one', 'two']]


def test_ellipsoids_and_boxes_keep_their_sizes(read):
    sizes = np.array([[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]])
    found = read('a', Ellipsoids(PLACES, sizes, QUATERNIONS, COLOURS))
    assert np.array(found['HalfSize3D'][0]) == pytest.approx(sizes)
    assert np.array(found['PoseRotationQuat'][0]) == pytest.approx(QUATERNIONS)
    assert np.array(found['PoseTranslation3D'][0]) == pytest.approx(PLACES)
    modes = {solid: read('a', Boxes(PLACES, sizes, COLOURS, solid))['FillMode']
             for solid in (False, True)}
    assert modes[False] != modes[True]


def test_lines_of_different_lengths_keep_their_points(read):
    strips = (PLACES, np.vstack([PLACES, PLACES + 1]))
    found = read('a', Lines(strips, (1.0, 0.0, 0.0), 3.0))
    for shown, strip in zip(found['LineStrip3D'][0], strips, strict=True):
        assert np.array(shown) == pytest.approx(strip)
    # A negative radius is in points of the screen.
    assert found['Radius'] == [pytest.approx([-1.5])]


def test_numbers_are_on_the_time_line_of_the_cycles(read):
    found = read('error/user_1', Number(0.5), Number(0.25))
    assert found['cycle'] == [1, 2]
    assert found['Scalar'] == [[0.5], [0.25]]


def test_a_picture_keeps_its_pixels(read):
    pixels = np.arange(6, dtype=np.uint8).reshape(2, 3)
    found = read('a', Picture(pixels))
    assert bytes(found['ImageBuffer'][0][0]) == pixels.tobytes()
    assert (found['ImageFormat'][0][0]['width'], found['ImageFormat'][0][0]['height']) == (3, 2)


def test_nothing_ends_what_was_shown(read):
    found = read('a', Number(0.5), Clear(), Number(0.25))
    assert found['cycle'] == [1, 2, 3]
    assert found['Scalar'] == [[0.5], [], [0.25]]


def test_texts_and_styles_are_accepted(read):
    found = read('log', Text('served'), Text('given up', warning=True))
    assert (found['Text'], found['TextLogLevel']) == ([['served'], ['given up']],
                                                      [['INFO'], ['WARN']])
    assert read('a', Series('dots', (1.0, 1.0, 1.0), dots=True))['MarkerSize']
    assert read('a', Series('line', (1.0, 1.0, 1.0)))['StrokeWidth']


def test_an_entry_of_cycle_zero_is_shown_at_all_times(tmp_path):
    stream = RerunStream()
    stream.save(tmp_path / 'view.rrd')
    stream.write([Entry(0, 'a', Number(1.0)), Entry(1, 'b', Number(1.0))])
    stream.close()
    schema = rerun.dataframe.load_recording(tmp_path / 'view.rrd').schema()
    static = {column.entity_path: column.is_static for column in schema.component_columns()}
    assert (static['/a'], static['/b']) == (True, False)


def test_the_layout_contains_every_chart_and_the_scene():
    shown = []

    def collect(part):
        for child in getattr(part, 'contents', ()):
            if hasattr(child, 'origin'):
                shown.append(child.origin)
            collect(child)
    collect(blueprint().root_container)
    assert sorted(shown) == sorted([
        *network_view.TITLES, network_view.WORLD, network_view.MODES, network_view.POSITIONING,
        network_view.TRANSMISSION, network_view.LOG])


def test_another_release_is_named_in_one_line(monkeypatch):
    monkeypatch.setattr(rerun, '__version__', '0.41.0')
    with pytest.raises(MissingLibraryError, match='needs rerun-sdk 0.22, found 0.41.0'):
        RerunStream()


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(OSError, match='missing'):
        RerunStream().save(tmp_path / 'missing' / 'view.rrd')


def test_serving_does_not_block():
    """Threads of Rerun free arrays, for which they wait for the global interpreter lock."""
    program = (
        'import socket\n'
        'from rhs_isac_ros.tools.rerun_stream import RerunStream\n'
        'for _ in range(5):\n'
        '    while True:\n'
        '        with socket.socket() as one, socket.socket() as two:\n'
        '            one.bind(("", 0))\n'
        '            port = one.getsockname()[1]\n'
        '            try:\n'
        '                two.bind(("", port + 1))\n'
        '                break\n'
        '            except OSError:\n'
        '                pass\n'
        '    stream = RerunStream()\n'
        '    stream.serve(port, "127.0.0.1")\n'
        '    stream.close()\n')
    subprocess.run([sys.executable, '-c', program], timeout=60, check=True)


def test_a_discarded_file_leaves_nothing(tmp_path):
    stream = RerunStream()
    stream.save(tmp_path / 'view.rrd')
    stream.write([Entry(1, 'a', Number(0.5))])
    stream.discard()
    assert not list(tmp_path.iterdir())
