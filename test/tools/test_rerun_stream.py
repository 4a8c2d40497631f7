"""The entries of a view in a file of Rerun, read back with its own reader."""


import numpy as np
import pytest

from rhs_isac_ros.monitoring import network_view, shapes
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.tools.rerun_stream import RerunStream, blueprint

rerun = pytest.importorskip('rerun', reason='rerun-sdk is not installed (scripts/setup view)')
rerun_file = pytest.importorskip('rerun_file')
PLACES = np.array([[9.0, 1.0, 0.5], [8.0, 2.0, 0.0]])
COLOURS = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
SIZES = np.array([[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]])
QUATERNIONS = np.array([[0.0, 0.0, 0.6, 0.8], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def read(tmp_path):
    """Function that writes one entity in each cycle, and returns what the file has of each."""
    def components(path, *entities):
        stream = RerunStream()
        stream.save(tmp_path / 'view.rrd')
        stream.write(shapes.Entry(cycle, path, entity) for cycle, entity in enumerate(entities, 1))
        stream.close()
        assert [file.name for file in tmp_path.iterdir()] == ['view.rrd']
        return rerun_file.read(tmp_path / 'view.rrd')[path]
    return components


@pytest.mark.parametrize(('entity', 'expected'), [
    *((shapes.Points(places, COLOURS, np.array([0.1, 0.2]), ('one', 'two')), {
        f'Position{places.shape[1]}D': places, 'Color': [0xff0080ff, 0x00ff00ff],
        'Radius': [0.1, 0.2]}) for places in (PLACES[:, :2], PLACES)),
    (shapes.Ellipsoids(PLACES, SIZES, QUATERNIONS, COLOURS), {
        'HalfSize3D': SIZES, 'RotationQuat': QUATERNIONS, 'Translation3D': PLACES}),
    (shapes.Boxes(PLACES, SIZES, COLOURS, True, QUATERNIONS), {
        'HalfSize3D': SIZES, 'RotationQuat': QUATERNIONS, 'Translation3D': PLACES}),
    # A negative radius is in points of the screen.
    (shapes.Lines((PLACES, PLACES + 1), (1.0, 0.0, 0.0), 3.0), {
        'LineStrip3D': (PLACES, PLACES + 1), 'Radius': [-1.5]}),
    # Every second row and column of the grid.
    (shapes.Mesh(np.stack([PLACES, 0 * PLACES]), (1.0, 1.0, 1.0)), {
        'LineStrip3D': (PLACES, PLACES * [[1], [0]])}),
    (shapes.Series('dots', (1.0, 1.0, 1.0), dots=True), {'MarkerSize': [4.0]}),
    (shapes.Series('', (1.0, 1.0, 1.0), dots=True), {'MarkerSize': [0.0]}),
    (shapes.Series('line', (1.0, 1.0, 1.0)), {'StrokeWidth': [2.0]})])
def test_an_entity_keeps_its_numbers(read, entity, expected):
    found = read('a', entity)
    assert list(found) == [1]
    for name, values in expected.items():
        assert np.array(found[1][name]) == pytest.approx(np.array(values))


def test_labels_and_texts_are_kept(read):
    found = read('a', shapes.Points(PLACES, COLOURS, np.array([0.1, 0.2]), ('one', 'two')))
    assert found[1]['Text'] == ['one', 'two']
    assert read('log', shapes.Text('served'), shapes.Text('given up', warning=True)) == {
        1: {'Text': ['served'], 'TextLogLevel': ['INFO']},
        2: {'Text': ['given up'], 'TextLogLevel': ['WARN']}}


def test_boxes_are_filled_or_outlined(read):
    one, other = (read('a', shapes.Boxes(PLACES, SIZES, COLOURS, solid))[1]['FillMode']
                  for solid in (False, True))
    assert one != other


def test_numbers_are_on_the_time_line_of_the_cycles(read):
    assert read('error/user_1', shapes.Number(0.5), shapes.Number(0.25)) == {
        1: {'Scalar': [0.5]}, 2: {'Scalar': [0.25]}}


def test_a_picture_keeps_its_pixels(read):
    pixels = np.arange(6, dtype=np.uint8).reshape(2, 3)
    found = read('a', shapes.Picture(pixels))[1]
    assert bytes(found['ImageBuffer'][0]) == pixels.tobytes()
    assert (found['ImageFormat'][0]['width'], found['ImageFormat'][0]['height']) == (3, 2)


def test_nothing_ends_what_was_shown(read):
    found = read('a', shapes.Number(0.5), shapes.Clear(), shapes.Number(0.25))
    assert {cycle: row.get('Scalar') or 'none' for cycle, row in found.items()} == {
        1: [0.5], 2: 'none', 3: [0.25]}


def test_an_entry_of_cycle_zero_is_shown_at_all_times(tmp_path):
    stream = RerunStream()
    stream.save(tmp_path / 'view.rrd')
    stream.write([shapes.Entry(0, 'a', shapes.Number(1.0)),
                  shapes.Entry(1, 'b', shapes.Number(1.0))])
    stream.close()
    found = rerun_file.read(tmp_path / 'view.rrd')
    assert (list(found['a']), list(found['b'])) == ([0], [1])


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
        network_view.TRANSMISSION, network_view.LOG, network_view.LEGEND])


def test_another_release_is_named_in_one_line(monkeypatch):
    monkeypatch.setattr(rerun, '__version__', '0.21.0')
    with pytest.raises(MissingLibraryError, match='needs rerun-sdk 0.22 to 0.41, found 0.21.0'):
        RerunStream()


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(OSError, match='missing'):
        RerunStream().save(tmp_path / 'missing' / 'view.rrd')


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path, full_disk):
    stream, place = RerunStream(), np.zeros((100, 3))
    stream.save(tmp_path / 'view.rrd')
    with full_disk(8192), pytest.raises(OSError, match='too large.*view.rrd.part'):
        stream.write(shapes.Entry(cycle, 'a', shapes.Points(place, place, place[:, 0]))
                     for cycle in range(1, 100))
        stream.close()
    stream.discard()
    assert not list(tmp_path.iterdir())


def test_a_second_view_leaves_the_file_of_the_first_alone(tmp_path):
    first, second = RerunStream(), RerunStream()
    first.save(tmp_path / 'view.rrd')
    with pytest.raises(FileExistsError, match='view.rrd.part'):
        second.save(tmp_path / 'view.rrd')
    second.discard()
    first.close()
    assert [file.name for file in tmp_path.iterdir()] == ['view.rrd']


def test_a_discarded_file_leaves_nothing(tmp_path):
    stream = RerunStream()
    stream.save(tmp_path / 'view.rrd')
    stream.write([shapes.Entry(1, 'a', shapes.Number(0.5))])
    stream.discard()
    assert not list(tmp_path.iterdir())
