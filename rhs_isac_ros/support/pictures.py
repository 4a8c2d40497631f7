"""Pictures in the style of the paper: formats, fonts, colours and marks."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.optional import optional_import

# Suffixes of pictures.
PICTURE_FORMATS = ('png', 'pdf', 'svg')
# Width of a column and of a page of two columns in the paper's document class, IEEEtran [in].
COLUMN_IN, PAGE_IN = 3.5, 7.16
# Colour map whose lightness grows with the value, even for colour-blind readers.
COLOUR_MAP = 'cividis'
# Only some versions of Matplotlib annotate the keys as literals.
_STYLE: dict[Any, object] = {
    # STIX resembles Times, the font of the paper, and is part of Matplotlib.
    'font.family': 'STIXGeneral', 'mathtext.fontset': 'stix', 'font.size': 8.0,
    'axes.labelsize': 8.0, 'axes.titlesize': 8.0, 'figure.titlesize': 9.0,
    'xtick.labelsize': 8.0, 'ytick.labelsize': 8.0,
    'legend.fontsize': 7.5, 'legend.title_fontsize': 7.5,
    'legend.framealpha': 0.9, 'legend.edgecolor': '0.7', 'legend.fancybox': False,
    'axes.linewidth': 0.6, 'axes.axisbelow': True,
    'grid.color': '0.88', 'grid.linewidth': 0.5,
    'lines.linewidth': 1.1, 'lines.markersize': 4.0, 'errorbar.capsize': 2.8,
    'patch.linewidth': 0.6, 'hatch.linewidth': 0.5,
    'boxplot.medianprops.color': 'black', 'boxplot.medianprops.linewidth': 1.4,
    'image.cmap': COLOUR_MAP,
    'figure.constrained_layout.use': True, 'savefig.dpi': 300.0,
    # Many publishers refuse fonts of type 3. Type 42 is TrueType, whose text can be searched.
    'pdf.fonttype': 42,
    # Text as outlines, because an SVG file contains no fonts.
    'svg.fonttype': 'path',
    # With a fixed salt, ids are the same in each run.
    'svg.hashsalt': 'rhs_isac_ros'}
# Decimal places of positions, which are relative to the size of a figure.
_POSITION_DIGITS = 6
# Without dates, repeated runs write the same file.
_METADATA: dict[str, dict[str, Any]] = {
    'png': {}, 'pdf': {'CreationDate': None}, 'svg': {'Date': None}}


class Look(NamedTuple):
    """Colour, marker, line style and hatch of one of several series.

    The colours of Okabe and Ito remain distinct for colour-blind readers. Markers, line styles and
    hatches remain distinct in greyscale, too.
    """

    colour: str
    marker: str
    line: str | tuple[float, tuple[float, ...]]
    hatch: str


# Neighbours differ in lightness. Yellow, the palest colour, comes last.
LOOKS = (
    Look('#0072B2', 'o', '-', ''),
    Look('#E69F00', 's', '--', '////'),
    Look('#000000', '^', '-.', '....'),
    Look('#009E73', 'D', ':', '\\\\\\\\'),
    Look('#CC79A7', 'v', (0, (5, 1, 1, 1, 1, 1)), 'xxxx'),
    Look('#56B4E9', 'P', (0, (1, 1)), '----'),
    Look('#D55E00', 'X', (0, (7, 2)), '++++'),
    Look('#F0E442', '*', (0, (3, 1)), 'oo'))


def look(index: int) -> Look:
    """Return the look of a series by its index; looks repeat after the last of `LOOKS`."""
    return LOOKS[index % len(LOOKS)]


@contextlib.contextmanager
def paper_style(purpose: str = 'drawing') -> Iterator[None]:
    """Draw in the style of the paper inside the block, whatever the user's settings are.

    It can also be used as a decorator. If Matplotlib is not installed, it raises
    MissingLibraryError with a message that begins with `purpose`.
    """
    with optional_import(purpose, extra='plot'):
        import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def new_figure(width_in: float, height_in: float) -> Any:
    """Return an empty Matplotlib figure, made without pyplot, which may open windows.

    Create the figure and draw on it inside `paper_style`.
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in))


def new_panels(
        width_in: float, height_in: float, n_rows: int, n_columns: int,
        **sharing: bool) -> tuple[Any, Any, Any]:
    """Return a new figure, its panels, and the axes for its legend; see `add_panels`."""
    figure = new_figure(width_in, height_in)
    return figure, *add_panels(figure.add_gridspec(1, 1)[0], n_rows, n_columns, **sharing)


def add_panels(
        place: Any, n_rows: int, n_columns: int, **sharing: bool) -> tuple[Any, Any]:
    """Add a grid of panels; return an array of the panels, and axes above them for a legend.

    `place` is a Matplotlib `SubplotSpec`; `sharing` may contain ``sharex`` and ``sharey``.
    """
    # The layout reserves the height of the legend. Before Matplotlib 3.7, it would reserve none
    # for a legend of the figure itself.
    grid = place.subgridspec(2, 1, height_ratios=(0.001, 1))
    panels = grid[1].subgridspec(n_rows, n_columns).subplots(squeeze=False, **sharing)
    above = panels[0, 0].figure.add_subplot(grid[0])
    above.axis('off')
    return panels, above


def label_decades(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers, within decades too; call this after drawing."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(
        subs=(1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 6, 8)))
    axis.set_major_formatter('{x:g}')
    axis.set_minor_formatter(NullFormatter())


def picture_format(path: str | Path) -> str:
    """Return the picture format that the suffix of `path` specifies, or raise ValueError."""
    kind = Path(path).suffix.lower().removeprefix('.')
    if kind not in PICTURE_FORMATS:
        raise ValueError(f'{str(path)!r}, expected a file name that ends in '
                         f'{", ".join("." + name for name in PICTURE_FORMATS)}')
    return kind


def write_picture(path: str | Path, figure: Any) -> None:
    """Write a Matplotlib figure atomically, in the format that the suffix of `path` specifies.

    Identical figures give identical files. Raises OSError if the file cannot be written, and
    ValueError if the suffix is not one of `PICTURE_FORMATS`.
    """
    kind = picture_format(path)
    # Matplotlib makes ticks and loads fonts only now.
    with paper_style():
        _fix_layout(figure)
        write_whole(path, lambda stream: figure.savefig(
            stream, format=kind, metadata=_METADATA[kind]))


def _fix_layout(figure: Any) -> None:
    """Lay out a figure, and round its positions, whose last digits differ between runs."""
    from matplotlib import rc_context
    from matplotlib.transforms import Bbox

    figure.draw_without_rendering()
    # Before Matplotlib 3.7, no layout engine has the name 'none'.
    with rc_context({'figure.constrained_layout.use': False}):
        figure.set_layout_engine(None)
    for axes in figure.axes:
        extents = axes.get_position(original=True).extents
        axes.set_position(Bbox.from_extents(extents.round(_POSITION_DIGITS)))
