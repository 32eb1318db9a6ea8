"""Charts drawn by matplotlib: SVG for HTML pages, PNG for documents."""

from __future__ import annotations

import io
from dataclasses import replace
from itertools import chain, pairwise
from typing import Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure as Canvas
from matplotlib.legend import Legend
from matplotlib.ticker import NullLocator

from perception.arrays import Floats
from studies import palette
from studies.page.model import Chart, Colours, Figure, MapChart, Numbers, Series, Timeline

_WIDTH = 0.8  # of all bars of a category
_WHISKERS = {"ecolor": palette.INK_FAINT, "elinewidth": 1.2, "capsize": 2}
_MAX_LEVEL_LETTERS = 70  # of all category labels together; beyond that they are tilted
_LINES = {"dashed": "--", "points": "none"}
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}


def draw_chart(chart: Chart, axes: Axes, colours: Colours) -> list[str]:
    """Draws a chart; returns the names for its legend."""
    chart = replace(chart, series=tuple(filter(_has_values, chart.series)))
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    axes.set_xscale("log" if chart.x_log else "linear")
    if chart.x_log:  # ticks at the studied values, in plain numbers
        axes.set_xticks(sorted({x for series in chart.series for x in series.x if x is not None}))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y" if chart.x_categories else "both")
    if chart.kind == "bar":
        _bars(chart, axes, colours)
    else:
        for series in chart.series:
            _line(series, axes, colours, chart)
    if chart.x_categories:
        axes.set_xticks(range(len(chart.x_categories)), chart.x_categories)
        if is_tight(chart.x_categories):
            axes.tick_params("x", rotation=40)
            for label in axes.get_xticklabels():
                label.set(ha="right", rotation_mode="anchor")
    if chart.from_zero:
        axes.set_ylim(bottom=0)
        axes.set_xlim(left=None if chart.x_categories or chart.x_log else 0)
    return [series.name for series in chart.series]


def _has_values(series: Series) -> bool:
    return any(value is not None for value in (*series.y, *chain(*series.points)))


def draw_timeline(timeline: Timeline, axes: Axes, colours: Colours) -> list[str]:
    """Draws a timeline; returns the names for its legend."""
    known, place = dict(timeline.colours), {row: i for i, row in enumerate(timeline.rows)}
    names = list(dict.fromkeys(span.name for span in timeline.spans))
    for name in names:
        spans = [span for span in timeline.spans if span.name == name]
        axes.barh(
            [place[span.row] for span in spans],
            [span.end - span.start for span in spans],
            left=[span.start for span in spans],
            height=0.6,
            color=known.get(name) or colours[name],
            label="-",
        )
    axes.set_yticks(range(len(place)), list(place))
    axes.invert_yaxis()
    axes.set_xlabel(timeline.x_label)
    axes.grid(axis="x")
    return names


def _line(series: Series, axes: Axes, colours: Colours, chart: Chart) -> None:
    colour = series.colour or colours[series.name]
    dash = colours.dash(series.name) if series.colour is None else "solid"
    axes.plot(
        series.x,
        _array(series.y),
        color=colour,
        linewidth=1.6,
        linestyle=_LINES.get(series.style, _DASHES[dash]),
        marker="o" if "points" in series.style else None,
        markersize=4,
        drawstyle="steps-post" if chart.kind == "steps" else "default",
        label="-",
    )
    if series.low is not None and series.high is not None:
        low, high = _array(series.low), _array(series.high)
        axes.fill_between(series.x, low, high, color=colour, alpha=0.2, linewidth=0)
    _draw_points(series, np.array(series.x, np.float64), axes, colour)


def _draw_points(series: Series, x: Floats, axes: Axes, colour: str) -> None:
    pairs = [(at, y) for at, values in zip(x, series.points, strict=False) for y in values]
    if pairs:
        places, heights = zip(*pairs, strict=True)
        axes.scatter(places, heights, s=14, facecolors="none", edgecolors=colour, linewidths=0.8)


def _bars(chart: Chart, axes: Axes, colours: Colours) -> None:
    count = 1 if chart.stacked else max(1, len(chart.series))
    step = _step(chart)
    width = _WIDTH * step / count
    floor: dict[float, float] = {}
    for number, series in enumerate(chart.series):
        shift = 0.0 if chart.stacked else (number - (count - 1) / 2) * width
        x, y = np.array(series.x, np.float64), _array(series.y)
        bottom = [floor.get(at, 0.0) for at in x] if chart.stacked else 0.0
        colour = series.colour or colours[series.name]
        errors = _whiskers(series)
        axes.bar(
            x + shift,
            y,
            width,
            bottom=bottom,
            color=colour,
            yerr=errors,
            error_kw=_WHISKERS,
            label="-",
        )
        for at, height in zip(x.tolist(), np.nan_to_num(y).tolist(), strict=True):
            floor[at] = floor.get(at, 0.0) + height


def _step(chart: Chart) -> float:
    """Returns the least distance between bars, which is 1 between categories."""
    places = sorted({at for series in chart.series for at in series.x})
    if chart.x_categories is not None or len(places) < 2:
        return 1.0
    return float(min(b - a for a, b in pairwise(places)))


def _whiskers(series: Series) -> Floats | None:
    if series.low is None or series.high is None:
        return None
    y = _array(series.y)
    return np.nan_to_num(np.stack([y - _array(series.low), _array(series.high) - y]))


def _array(values: Numbers) -> Floats:
    return np.array([np.nan if value is None else value for value in values], np.float64)


def is_tight(names: tuple[str, ...]) -> bool:
    """Whether the labels of categories would overlap."""
    return len(names) * (max(map(len, names), default=0) + 2) > _MAX_LEVEL_LETTERS


_MARKS = {"disc": "o", "cross": "x", "star": "*"}
_LABEL_AT = (5, 5)  # from its point
_CLOUD = 200  # points from which on they are a cloud


def draw_map(chart: MapChart, axes: Axes, colours: Colours) -> list[str]:
    """Draws a map; returns the names for its legend."""
    axes.set(aspect="equal", xlabel="east, m", ylabel="north, m")
    axes.add_collection(PolyCollection(chart.surfaces, facecolors=palette.ROAD, edgecolors="none"))
    axes.add_collection(LineCollection(chart.lines, colors=palette.ROAD_EDGE, linewidths=0.6))
    for outlines in chart.outlines:
        colour = outlines.colour or colours[outlines.name]
        drawn = PolyCollection(
            outlines.rings, facecolors="none", edgecolors=colour, linewidths=1.0, label="-"
        )
        axes.add_collection(drawn)
    for points in chart.points:
        colour = points.colour or colours[points.name]
        is_line = points.mark == "cross"
        axes.scatter(
            points.x_m,
            points.y_m,
            s=points.size**2 / 2,
            color=colour,
            marker=_MARKS[points.mark],
            linewidths=1.0 if is_line else 0,
            alpha=0.6 if len(points.x_m) > _CLOUD else 0.95,
            rasterized=len(points.x_m) > _CLOUD,
            label="-",
        )
        for x_m, y_m, label in zip(points.x_m, points.y_m, points.labels, strict=False):
            axes.annotate(
                label, (x_m, y_m), xytext=_LABEL_AT, textcoords="offset points", fontsize=7,
                color=palette.INK, parse_math=False, clip_on=True,
            )  # fmt: skip
    axes.autoscale_view()
    if chart.window is not None:
        left, low, right, high = chart.window
        axes.set(xlim=(left, right), ylim=(low, high))
    return [one.name for one in chart.outlines] + [one.name for one in chart.points]


_DPI = 120
_WIDTH_IN, _HALF_IN = 8.0, 5.2
_LEGEND_LETTERS = 110  # that fit beside each other
_NO_METADATA = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}
_STYLE = {
    "svg.hashsalt": "cpnet",  # names of an SVG's parts follow from this, not from chance
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


def draw(
    figure: Figure, colours: Colours, form: Literal["png", "svg"], *, is_half: bool = False
) -> bytes:
    """Returns the picture of a chart; the same chart gives the same bytes.

    An SVG has no title, as the page around it shows one, and its letters are outlines: it needs no
    font. Clouds of points are pixels in it. `is_half` draws it for half the page's width.
    """
    with mpl.rc_context(_STYLE):
        canvas = Canvas(
            figsize=_size(figure, _HALF_IN if is_half else _WIDTH_IN),
            dpi=_DPI,
            layout="constrained",
        )
        FigureCanvasAgg(canvas)
        axes = canvas.add_subplot()
        names = _draw_figure(figure, axes, colours)
        if len(names) > 1 or isinstance(figure, MapChart | Timeline):
            _legend(canvas, axes, names)
        if form == "png":
            canvas.suptitle(figure.title, x=0.01, ha="left", fontsize=12, fontweight="bold")
        buffer = io.BytesIO()
        canvas.savefig(buffer, format=form, metadata=_NO_METADATA[form])
    return buffer.getvalue()


def _draw_figure(figure: Figure, axes: Axes, colours: Colours) -> list[str]:
    """Draws and returns the names of what was drawn, in the order of the legend."""
    if isinstance(figure, Chart):
        return draw_chart(figure, axes, colours)
    if isinstance(figure, Timeline):
        return draw_timeline(figure, axes, colours)
    return draw_map(figure, axes, colours)


def _size(figure: Figure, width_in: float) -> tuple[float, float]:
    if isinstance(figure, MapChart):
        return width_in, min(max(2.4, 1.3 + 0.9 * width_in * figure.aspect), 9.0)
    if isinstance(figure, Timeline):
        return width_in, 1.6 + 0.45 * len(figure.rows)
    return width_in, 1.2 + 0.375 * width_in


def _legend(canvas: Canvas, axes: Axes, names: list[str]) -> None:
    handles = axes.get_legend_handles_labels()[0]
    if not handles:
        return
    letters = _LEGEND_LETTERS * canvas.get_figwidth() / _WIDTH_IN
    columns = max(1, min(len(handles), int(letters // (max(map(len, names)) + 6))))
    legend: Legend = canvas.legend(
        handles,
        [" "] * len(handles),
        loc="outside lower center",
        ncols=columns,
        fontsize=9,
        markerscale=1.5,
    )
    for text, name in zip(legend.get_texts(), names, strict=True):  # "_" would hide it
        text.set_text(name)
