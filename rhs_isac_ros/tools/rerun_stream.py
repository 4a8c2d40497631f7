"""Output of a view to Rerun: a file, or a server for browsers. Requires the library rerun."""

import os
import socket
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rhs_isac_ros.monitoring import network_view, shapes
from rhs_isac_ros.support.files import writing
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

# Releases 0.N of rerun.
_OLDEST, _NEWEST = 22, 41
# Name of the timeline in the viewer.
_TIMELINE = 'cycle'
# Number of coordinates in a plane.
_PLANE = 2
# Sizes in screen points.
_DOT_SIZE, _LINE_WIDTH, _OUTLINE_WIDTH = 4.0, 2.0, 1.2
# A mesh is drawn as every second line of its grid, thin and dim, so that entities behind it remain
# visible.
_MESH_WIDTH, _MESH_STEP, _MESH_DIM = 0.6, 2, 0.45
_BACKGROUND = (16, 18, 22)
# Number of bytes whose writing shows whether a disk is full.
_PROBE = 2**16
# Maximum time for the server of the viewer to start, and period of checking [s].
_START_S, _POLL_S = 20.0, 0.05


def _library() -> Any:
    """Return rerun, with the names of its newer releases and with what its server expects.

    `ports` are options for the ports of the viewer, of its data, and of this process; the last two
    are one in releases after 0.22. `data` and `address` format their addresses. Release 0.22 is
    the last one for NumPy 1.26, the one of stock Jazzy.
    """
    with optional_import('view', extra='view'):
        import rerun as rr

    def of_one(archetype: Any) -> Any:
        return lambda **values: archetype(**{name[:-1]: value for name, value in values.items()})

    release = int(rr.__version__.split('.')[1])
    if not _OLDEST <= release <= _NEWEST:
        raise MissingLibraryError(
            f'view needs rerun-sdk 0.{_OLDEST} to 0.{_NEWEST}, found {rr.__version__} '
            "(pip install 'rhs_isac_ros[view]'; in a clone: scripts/setup view)")
    if release > _OLDEST:
        return SimpleNamespace(
            **vars(rr), ports=('--web-viewer-port', '--port'),
            data='rerun%2Bhttp://{}:{}/proxy', address='rerun+http://{}:{}/proxy')
    return SimpleNamespace(**vars(rr) | {
        'RecordingStream': rr.new_recording, 'set_time': rr.set_time_sequence,
        'connect_grpc': rr.connect_tcp, 'Scalars': rr.Scalar,
        'SeriesPoints': of_one(rr.SeriesPoint), 'SeriesLines': of_one(rr.SeriesLine),
        'ports': ('--web-viewer-port', '--ws-server-port', '--port'),
        'data': 'ws://{}:{}', 'address': '{}:{}'})


class RerunStream:
    """Writes the entries of a view; raises MissingLibraryError if no known rerun is installed."""

    def __init__(self) -> None:
        self._rerun = _library()
        self._rerun.set_strict_mode(True)
        self._stream = self._rerun.RecordingStream('rhs_isac_ros')
        # The incomplete file, and its final path.
        self._files: tuple[Path, Path] | None = None
        self._server: subprocess.Popen[bytes] | None = None

    def save(self, path: Path) -> None:
        """Write to ``<name>.part``, which `close` renames.

        Raises OSError if this file exists, because another view writes it, or is unwritable.
        """
        partial = path.with_name(f'{path.name}.part')
        # Rerun reports an unwritable file without its reason.
        partial.open('xb').close()
        self._files = partial, path
        self._rerun.save(partial, default_blueprint=blueprint(), recording=self._stream)
        self._begin()

    def serve(self, port: int, bind: str) -> str:
        """Serve the viewer on a port, and the data on the next one; return the address.

        Release 0.22 of rerun receives the data of this process on a third port, ``port + 2``.
        `bind` is the address of a network interface, or ``0.0.0.0`` for all. Raises OSError if a
        port is in use or the address is not one of this machine, and RuntimeError if the server
        does not start.
        """
        rerun = self._rerun
        ports = range(port, port + len(rerun.ports))
        for number in ports:
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((bind, number))
        # A server in this process would listen on all network interfaces. The kernel ends the new
        # process when this one ends; a server that `python -m rerun` starts would remain.
        program = Path(rerun.__file__).parents[1] / 'rerun_cli' / 'rerun'
        self._server = subprocess.Popen(
            ['setpriv', '--pdeathsig', 'TERM', program, '--serve-web', '--bind', bind,
             *(f'{option}={number}' for option, number in zip(rerun.ports, ports, strict=True))],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True)
        host = 'localhost' if bind in ('127.0.0.1', '0.0.0.0') else bind
        end_s = time.monotonic() + _START_S
        for number in ports:
            while not _is_listening(host, number):
                if self._server.poll() is not None or time.monotonic() > end_s:
                    raise RuntimeError('the Rerun server does not start')
                time.sleep(_POLL_S)
        rerun.connect_grpc(
            rerun.address.format('127.0.0.1' if host == 'localhost' else host, ports[-1]),
            recording=self._stream)
        rerun.send_blueprint(blueprint(), recording=self._stream)
        self._begin()
        # Some colours are illegible on the light background that a desktop may prefer.
        return f'http://{host}:{port}/?theme=dark&url={rerun.data.format(host, port + 1)}'

    def _begin(self) -> None:
        self._rerun.log(network_view.WORLD, self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP,
                        static=True, recording=self._stream)

    def write(self, entries: Iterable[shapes.Entry]) -> None:
        """Write entries of a view."""
        for cycle, path, entity in entries:
            if cycle:
                self._rerun.set_time(_TIMELINE, sequence=cycle, recording=self._stream)
            self._rerun.log(
                path, _archetype(self._rerun, entity), static=not cycle, recording=self._stream)

    def close(self) -> None:
        """Complete the file, or stop the server; raise OSError if the disk is full."""
        self._disconnect()
        if self._files:
            partial, path = self._files
            # Rerun only prints this error; it occurs again.
            with writing(partial), partial.open('r+b') as file:
                size = file.seek(0, os.SEEK_END)
                file.write(bytes(_PROBE))
                file.flush()
                file.truncate(size)
            partial.replace(path)

    def discard(self) -> None:
        """Remove the incomplete file, or stop the server."""
        self._disconnect()
        if self._files:
            self._files[0].unlink(missing_ok=True)

    def _disconnect(self) -> None:
        self._rerun.disconnect(recording=self._stream)
        if self._server is not None:
            self._server.terminate()
            self._server.wait()


def _is_listening(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def blueprint() -> Any:
    """Return the layout: the scene above modes and surface, beside the charts and the log."""
    import rerun.blueprint as rrb

    scene = rrb.Spatial3DView(
        origin=network_view.WORLD, name='Scene (surface enlarged)', background=_BACKGROUND)
    reach, height = network_view.REACH_M, network_view.HEIGHT_M
    modes = rrb.Spatial2DView(
        origin=network_view.MODES, background=_BACKGROUND,
        name='Modes: probability over range error [m]',
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-1.25 * reach, 1.1 * reach], y_range=[-1.1 * height, 0.2 * height]))
    positioning = rrb.Spatial2DView(origin=network_view.POSITIONING, name='Surface: pilots')
    transmission = rrb.Spatial2DView(origin=network_view.TRANSMISSION, name='Surface: data')
    # The legends of the charts would hide values.
    error, *others = (
        rrb.TimeSeriesView(origin=path, name=title, plot_legend=rrb.PlotLegend(visible=False))
        for path, title in network_view.TITLES.items())
    legend = rrb.Spatial2DView(
        origin=network_view.LEGEND, name='Legend', background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-1.0, 1.0], y_range=[-1.0, network_view.LEGEND_LINES]))
    log = rrb.TextLogView(origin=network_view.LOG, name='Cycles')
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(
                modes, rrb.Vertical(positioning, transmission), column_shares=[3, 2]),
                row_shares=[5, 3]),
            # The log is wide, because its text is in the last of six columns.
            rrb.Vertical(
                rrb.Horizontal(
                    rrb.Vertical(error, rrb.Grid(*others, grid_columns=2), row_shares=[4, 6]),
                    legend, column_shares=[6, 1]),
                log, row_shares=[10, 3]),
            column_shares=[1, 1]),
        rrb.TimePanel(state='collapsed'), rrb.SelectionPanel(state='hidden'),
        rrb.BlueprintPanel(state='hidden'))


def _archetype(rr: Any, entity: shapes.Entity) -> Any:
    mode = rr.components.FillMode
    match entity:
        case shapes.Placement(origin, rotation):
            return rr.Transform3D(translation=origin, mat3x3=rotation)
        case shapes.Points(positions, colours, radii_m, labels):
            points = rr.Points2D if positions.shape[1] == _PLANE else rr.Points3D
            return points(positions, colors=_colours(colours), radii=radii_m,
                          labels=labels or None, show_labels=bool(labels))
        case shapes.Ellipsoids(centres, half_sizes_m, quaternions, colours):
            return rr.Ellipsoids3D(
                centers=centres, half_sizes=half_sizes_m, quaternions=quaternions,
                colors=_colours(colours), line_radii=_radius(_OUTLINE_WIDTH),
                fill_mode=mode.MajorWireframe)
        case shapes.Boxes(centres, half_sizes_m, colours, solid, quaternions):
            return rr.Boxes3D(
                centers=centres, half_sizes=half_sizes_m, quaternions=quaternions,
                colors=_colours(colours), radii=_radius(_OUTLINE_WIDTH),
                fill_mode=mode.Solid if solid else mode.MajorWireframe)
        case shapes.Lines(strips, colour, width):
            is_plane = bool(strips) and strips[0].shape[1] == _PLANE
            lines = rr.LineStrips2D if is_plane else rr.LineStrips3D
            return lines(strips, colors=_colours([colour]), radii=_radius(width))
        case shapes.Mesh(points, colour):
            grid = [*points[::_MESH_STEP], *np.swapaxes(points, 0, 1)[::_MESH_STEP]]
            # Most lines of a lobe collapse to the origin.
            return rr.LineStrips3D(
                [line for line in grid if line.any()], radii=_radius(_MESH_WIDTH),
                colors=_colours(_MESH_DIM * np.array([colour])))
        case shapes.Picture(pixels):
            return rr.Image(pixels, color_model='L')
        case shapes.Series(name, colour, dots):
            shown = _colours(colour).tolist()
            if dots:
                return rr.SeriesPoints(colors=shown, names=name, markers='circle',
                                       marker_sizes=_DOT_SIZE if name else 0.0)
            return rr.SeriesLines(colors=shown, names=name, widths=_LINE_WIDTH)
        case shapes.Number(value):
            return rr.Scalars(value)
        case shapes.Text(text, warning):
            return rr.TextLog(text, level='WARN' if warning else 'INFO')
        case _:
            return rr.Clear(recursive=True)


def _radius(width: float) -> float:
    """Convert a width in screen points to a radius; in Rerun, such radii are negative."""
    return -width / 2


def _colours(values: Any) -> np.ndarray:
    return np.rint(255 * np.array(values)).astype(np.uint8)
