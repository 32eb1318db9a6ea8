"""Charts as PNG files: the same charts as on the HTML page, for documents."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.legend import Legend

from studies import palette
from studies.page.charts import Chart, MapChart, Timeline
from studies.page.colours import Colours
from studies.page.model import Figure
from studies.page.strokes import draw_chart, draw_timeline
from studies.page.strokes_map import draw_map

_DPI = 120
_LEGEND_LETTERS = 110  # that fit beside each other
_STYLE = {
    "text.parse_math": False,  # names are shown as they are, dollars too
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": palette.INK,
    "axes.labelcolor": palette.INK,
    "axes.edgecolor": palette.QUIET,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": palette.INK_FAINT,
    "ytick.color": palette.INK_FAINT,
    "grid.color": palette.GRID,
    "legend.frameon": False,
}


def save_png(figure: Figure, colours: Colours, path: Path) -> None:
    """Draws a chart into a file; the same chart gives the same bytes.

    Raises:
        OSError: the file cannot be written.
    """
    with mpl.rc_context(_STYLE):
        canvas = Canvas(figsize=_size(figure), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(canvas)
        axes = canvas.add_subplot()
        names = _draw(figure, axes, colours)
        if len(names) > 1 or isinstance(figure, MapChart | Timeline):
            _legend(canvas, axes, names)
        canvas.suptitle(figure.title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        canvas.savefig(path, format="png", metadata={"Software": None})


def _draw(figure: Figure, axes: Axes, colours: Colours) -> list[str]:
    """Draws and returns the names of what was drawn, in the order of the legend."""
    if isinstance(figure, Chart):
        return draw_chart(figure, axes, colours)
    if isinstance(figure, Timeline):
        return draw_timeline(figure, axes, colours)
    return draw_map(figure, axes, colours)


def _size(figure: Figure) -> tuple[float, float]:
    if isinstance(figure, MapChart):
        return 8.0, min(max(2.4, 1.3 + 7.2 * figure.aspect), 9.0)
    if isinstance(figure, Timeline):
        return 8.0, 1.6 + 0.45 * len(figure.rows)
    return 8.0, 4.2


def _legend(canvas: Canvas, axes: Axes, names: list[str]) -> None:
    handles = axes.get_legend_handles_labels()[0]
    if not handles:
        return
    columns = max(1, min(len(handles), _LEGEND_LETTERS // (max(map(len, names)) + 6)))
    legend: Legend = canvas.legend(
        handles,
        [" "] * len(handles),
        loc="outside lower center",
        ncols=columns,
        fontsize=9,
        markerscale=1.5,
    )
    for text, name in zip(legend.get_texts(), names, strict=True):  # an underscore is no secret
        text.set_text(name)
