"""How charts are drawn by matplotlib."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from perception.arrays import Floats
from studies.page.charts import Chart, Numbers, Series, Timeline
from studies.page.colours import Colours
from studies.page.layout import is_tight

_WIDTH = 0.8  # of all bars of a category
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}


def draw_chart(chart: Chart, axes: Axes, colours: Colours) -> list[str]:
    """Draws a chart; returns what its legend says."""
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    axes.set_xscale("log" if chart.x_log else "linear")
    axes.set_yscale("log" if chart.y_log else "linear")
    if chart.x_log:  # what was studied, in plain numbers
        axes.set_xticks(sorted({x for series in chart.series for x in series.x if x is not None}))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    if chart.y_log:
        axes.yaxis.set_major_formatter("{x:g}")
    axes.grid(axis="y" if chart.x_categories else "both")
    if chart.kind == "bar":
        _bars(chart, axes, colours)
    else:
        for series in chart.series:
            draw = _histogram if chart.kind == "histogram" else _line
            draw(series, axes, colours, chart)
    if chart.x_categories:
        axes.set_xticks(range(len(chart.x_categories)), chart.x_categories)
        if is_tight(chart.x_categories):
            axes.tick_params("x", rotation=40)
            for label in axes.get_xticklabels():
                label.set(ha="right", rotation_mode="anchor")
    return [series.name for series in chart.series]


def draw_timeline(timeline: Timeline, axes: Axes, colours: Colours) -> list[str]:
    """Draws a timeline; returns what its legend says."""
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
    y = (*series.y, *series.y[-1:]) if len(series.x) > len(series.y) else series.y
    axes.plot(
        series.x,
        _array(y),
        color=colour,
        linewidth=1.6,
        linestyle={"dashed": "--", "points": "none"}.get(series.style, _DASHES[dash]),
        marker="o" if "points" in series.style else None,
        markersize=4,
        drawstyle="steps-post" if chart.kind == "steps" else "default",
        label="-",
    )
    if series.low is not None and series.high is not None:
        x = series.x[: len(series.y)]
        low, high = _array(series.low), _array(series.high)
        axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)


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
            x + shift, y, width, bottom=bottom, color=colour, yerr=errors, capsize=2, label="-"
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


def _histogram(series: Series, axes: Axes, colours: Colours, chart: Chart) -> None:
    axes.stairs(
        np.nan_to_num(_array(series.y)),
        series.x,
        fill=True,
        color=series.colour or colours[series.name],
        alpha=1.0 if len(chart.series) == 1 else 0.55,
        label="-",
    )


def _array(values: Numbers) -> Floats:
    return np.array([np.nan if value is None else value for value in values], np.float64)
