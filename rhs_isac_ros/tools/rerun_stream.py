"""Output of a view to Rerun: a file, or a server for browsers. Requires the library rerun."""

import os
import socket
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.monitoring import network_view, shapes
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

_VERSION = '0.22'
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
# Maximum time for the server of the viewer to start, and period of checking [s].
_START_S, _POLL_S = 20.0, 0.05


class RerunStream:
    """Writes the entries of a view; raises MissingLibraryError if rerun-sdk 0.22 is missing."""

    def __init__(self) -> None:
        with optional_import('view', extra='view'):
            import rerun
        if not rerun.__version__.startswith(f'{_VERSION}.'):
            raise MissingLibraryError(
                f'view needs rerun-sdk {_VERSION}, found {rerun.__version__} '
                "(pip install 'rhs_isac_ros[view]'; in a clone: scripts/setup view)")
        self._rerun = rerun
        rerun.set_strict_mode(True)
        self._stream = rerun.new_recording('rhs_isac_ros')
        # The incomplete file, and its final path.
        self._files: tuple[Path, Path] | None = None
        self._server: subprocess.Popen[bytes] | None = None

    def save(self, path: Path) -> None:
        """Write to ``<name>.part``, which `close` renames; raise OSError if it is unwritable."""
        partial = path.with_name(f'{path.name}.part')
        self._files = partial, path
        # Rerun reports an unwritable file without its reason.
        partial.open('wb').close()
        self._rerun.save(partial, default_blueprint=blueprint(), recording=self._stream)
        self._begin()

    def serve(self, port: int, bind: str) -> str:
        """Serve the viewer on a port, and the data on the next one; return the address.

        A third port, ``port + 2``, receives the data from this process. `bind` is the address of a
        network interface, or ``0.0.0.0`` for all. Raises OSError if a port is in use or the
        address is not one of this machine, and RuntimeError if the server does not start.
        """
        ports = range(port, port + 3)
        for number in ports:
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((bind, number))
        # A server in this process would listen on all network interfaces. The kernel ends the new
        # process when this one ends; a server that `python -m rerun` starts would remain.
        program = Path(self._rerun.__file__).parents[1] / 'rerun_cli' / 'rerun'
        self._server = subprocess.Popen(
            ['setpriv', '--pdeathsig', 'TERM', program, '--serve-web', '--bind', bind,
             '--web-viewer-port', str(port), '--ws-server-port', str(port + 1),
             '--port', str(port + 2)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True)
        host = 'localhost' if bind in ('127.0.0.1', '0.0.0.0') else bind
        end_s = time.monotonic() + _START_S
        for number in ports:
            while not _is_listening(host, number):
                if self._server.poll() is not None or time.monotonic() > end_s:
                    raise RuntimeError('the Rerun server does not start')
                time.sleep(_POLL_S)
        self._rerun.connect_tcp(
            f'{"127.0.0.1" if host == "localhost" else host}:{ports[-1]}',
            recording=self._stream)
        self._rerun.send_blueprint(blueprint(), recording=self._stream)
        self._begin()
        return f'http://{host}:{port}/?url=ws://{host}:{port + 1}'

    def _begin(self) -> None:
        self._rerun.log(network_view.WORLD, self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP,
                        static=True, recording=self._stream)

    def write(self, entries: Iterable[shapes.Entry]) -> None:
        """Write entries of a view."""
        for cycle, path, entity in entries:
            if cycle:
                self._rerun.set_time_sequence(_TIMELINE, cycle, recording=self._stream)
            self._rerun.log(
                path, _archetype(entity), static=not cycle, recording=self._stream)

    def close(self) -> None:
        """Complete the file, or stop the server."""
        self._disconnect()
        if self._files:
            os.replace(*self._files)

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
    # On the right, the legend would hide new values. A single series needs no legend.
    error, *others = (
        rrb.TimeSeriesView(origin=path, name=title, plot_legend=rrb.PlotLegend(
            rrb.Corner2D.LeftTop, visible=path != 'loss'))
        for path, title in network_view.TITLES.items())
    log = rrb.TextLogView(origin=network_view.LOG, name='Cycles')
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(
                modes, rrb.Vertical(positioning, transmission), column_shares=[3, 2]),
                row_shares=[5, 3]),
            # The log is wide, because its text is in the last of six columns.
            rrb.Vertical(error, rrb.Grid(*others, grid_columns=2), log, row_shares=[4, 6, 3]),
            column_shares=[1, 1]),
        rrb.TimePanel(state='collapsed'), rrb.SelectionPanel(state='hidden'),
        rrb.BlueprintPanel(state='hidden'))


def _archetype(entity: shapes.Entity) -> Any:
    import rerun as rr

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
        case shapes.Boxes(centres, half_sizes_m, colours, solid):
            return rr.Boxes3D(
                centers=centres, half_sizes=half_sizes_m, colors=_colours(colours),
                radii=_radius(_OUTLINE_WIDTH),
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
                return rr.SeriesPoint(color=shown, name=name, marker='circle',
                                      marker_size=_DOT_SIZE)
            return rr.SeriesLine(color=shown, name=name, width=_LINE_WIDTH)
        case shapes.Number(value):
            return rr.Scalar(value)
        case shapes.Text(text, warning):
            return rr.TextLog(text, level='WARN' if warning else 'INFO')
        case _:
            return rr.Clear(recursive=True)


def _radius(width: float) -> float:
    """Convert a width in screen points to a radius; in Rerun, such radii are negative."""
    return -width / 2


def _colours(values: Any) -> np.ndarray:
    return np.rint(255 * np.array(values)).astype(np.uint8)
