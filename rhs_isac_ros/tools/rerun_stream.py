"""A view as a recording of Rerun: in a file, or served to browsers. Needs the library rerun."""

import os
import socket
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rhs_isac_ros.monitoring import network_view
from rhs_isac_ros.monitoring.shapes import (
    Boxes,
    Ellipsoids,
    Entity,
    Entry,
    Lines,
    Number,
    Picture,
    Points,
    Series,
    Text,
)
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

if TYPE_CHECKING:
    import rerun.blueprint

_VERSION = '0.22'
_APPLICATION = 'rhs_isac_ros'
# The time line of the viewer.
_TIMELINE = 'cycle'
_MAX_COLOUR = 255
# Number of coordinates in a plane.
_PLANE = 2
_DOT_SIZE = 4.0
_LINE_WIDTH = 2.0
# Width of outlines in points of the screen.
_OUTLINE_WIDTH = 1.2
_BACKGROUND = (16, 18, 22)


# Maximum time until the server of the viewer listens, and the period of the attempts [s].
_START_S, _POLL_S = 20.0, 0.05


class RerunStream:
    """Writes the entries of a view.

    Raises
    ------
    MissingLibraryError
        If rerun-sdk 0.22 is not installed.
    """

    def __init__(self) -> None:
        with optional_import('view', extra='view'):
            import rerun
        if not rerun.__version__.startswith(f'{_VERSION}.'):
            raise MissingLibraryError(
                f'view needs rerun-sdk {_VERSION}, found {rerun.__version__} '
                "(pip install 'rhs_isac_ros[view]'; in a clone: scripts/setup view)")
        self._rerun = rerun
        rerun.set_strict_mode(True)
        self._stream = rerun.new_recording(_APPLICATION)
        self._path: Path | None = None
        self._server: subprocess.Popen[bytes] | None = None

    def save(self, path: Path) -> None:
        """Write to a file, which is ``<name>.part`` until `close`.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        self._path = path
        # Rerun reports an unwritable file without its reason.
        self._partial.open('wb').close()
        self._rerun.save(self._partial, default_blueprint=blueprint(), recording=self._stream)
        self._begin()

    def serve(self, port: int, bind: str) -> str:
        """Serve the viewer on a port and the data on the next one; return the address.

        The port after these receives the data from this process.

        Parameters
        ----------
        bind
            Address of the network interface; ``0.0.0.0`` stands for all.

        Raises
        ------
        OSError
            If a port is not free, or the address is not one of this machine.
        RuntimeError
            If the server does not start.
        """
        ports = range(port, port + 3)
        for number in ports:
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((bind, number))
        # A process, because a server in this one would listen on all network interfaces. It ends
        # with this process. `python -m rerun` would run it as a child of its own.
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
                    raise RuntimeError('the server of Rerun does not start')
                time.sleep(_POLL_S)
        self._rerun.connect_tcp(
            f'{"127.0.0.1" if host == "localhost" else host}:{ports[-1]}',
            recording=self._stream)
        self._rerun.send_blueprint(blueprint(), recording=self._stream)
        self._begin()
        return f'http://{host}:{port}/?url=ws://{host}:{port + 1}'

    def write(self, entries: Iterable[Entry]) -> None:
        """Write entries of a view."""
        for cycle, path, entity in entries:
            if cycle:
                self._rerun.set_time_sequence(_TIMELINE, cycle, recording=self._stream)
            self._rerun.log(
                path, _archetype(entity), static=not cycle, recording=self._stream)

    def close(self) -> None:
        """Complete the file, or end the service."""
        self._disconnect()
        if self._path is not None:
            os.replace(self._partial, self._path)

    def discard(self) -> None:
        """Remove the incomplete file, or end the service."""
        self._disconnect()
        if self._path is not None:
            self._partial.unlink(missing_ok=True)

    def _disconnect(self) -> None:
        self._rerun.disconnect(recording=self._stream)
        if self._server is not None:
            self._server.terminate()
            self._server.wait()

    @property
    def _partial(self) -> Path:
        assert self._path is not None
        return self._path.with_name(f'{self._path.name}.part')

    def _begin(self) -> None:
        self._rerun.log(network_view.WORLD, self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP,
                        static=True, recording=self._stream)


def _is_listening(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def blueprint() -> 'rerun.blueprint.Blueprint':
    """Return the layout: the scene above the modes, beside charts, the surface and the log."""
    import rerun.blueprint as rrb

    scene = rrb.Spatial3DView(
        origin=network_view.WORLD, name='Scene (surface enlarged)', background=_BACKGROUND)
    reach, height = network_view.REACH_M, network_view.HEIGHT_M
    modes = rrb.Spatial2DView(
        origin=network_view.MODES, background=_BACKGROUND,
        name='Modes: probability over range error [m]',
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-1.25 * reach, 1.1 * reach], y_range=[-1.1 * height, 0.2 * height]))
    positioning = rrb.Spatial2DView(
        origin=network_view.POSITIONING, name='Surface: pilots')
    transmission = rrb.Spatial2DView(
        origin=network_view.TRANSMISSION, name='Surface: data')
    # New values appear on the right, where a legend would hide them; a single series needs none.
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


def _archetype(entity: Entity) -> Any:
    """Convert an entity to an archetype of Rerun."""
    import rerun as rr

    match entity:
        case Points():
            points = rr.Points2D if entity.positions.shape[1] == _PLANE else rr.Points3D
            return points(entity.positions, colors=_colours(entity.colours),
                          radii=entity.radii_m, labels=entity.labels or None,
                          show_labels=bool(entity.labels))
        case Ellipsoids():
            return rr.Ellipsoids3D(
                centers=entity.centres, half_sizes=entity.half_sizes_m,
                quaternions=entity.quaternions, colors=_colours(entity.colours),
                line_radii=_radius(_OUTLINE_WIDTH),
                fill_mode=rr.components.FillMode.MajorWireframe)
        case Boxes():
            mode = rr.components.FillMode
            return rr.Boxes3D(
                centers=entity.centres, half_sizes=entity.half_sizes_m,
                colors=_colours(entity.colours), radii=_radius(_OUTLINE_WIDTH),
                fill_mode=mode.Solid if entity.solid else mode.MajorWireframe)
        case Lines():
            is_plane = bool(entity.strips) and entity.strips[0].shape[1] == _PLANE
            strips = rr.LineStrips2D if is_plane else rr.LineStrips3D
            return strips(entity.strips, colors=_colours(np.array([entity.colour])),
                          radii=_radius(entity.width))
        case Picture():
            return rr.Image(entity.pixels, color_model='L')
        case Series(name, colour, dots):
            red, green, blue = _colours(np.array(colour)).tolist()
            if dots:
                return rr.SeriesPoint(color=[red, green, blue], name=name,
                                      marker='circle', marker_size=_DOT_SIZE)
            return rr.SeriesLine(color=[red, green, blue], name=name, width=_LINE_WIDTH)
        case Number(value):
            return rr.Scalar(value)
        case Text(text, warning):
            return rr.TextLog(text, level='WARN' if warning else 'INFO')
        case _:
            return rr.Clear(recursive=True)


def _radius(width: float) -> float:
    """Convert a width in points of the screen: Rerun uses negative radii for these."""
    return -width / 2


def _colours(values: np.ndarray) -> np.ndarray:
    """Convert colours from 0 to 1 to uint8."""
    return np.rint(_MAX_COLOUR * values).astype(np.uint8)
