"""Charts as Plotly takes them: traces and a layout, as plain JSON values."""

from __future__ import annotations

from itertools import groupby, pairwise

from studies import palette
from studies.page.charts import Chart, Numbers, Series
from studies.page.colours import Colours
from studies.page.layout import BASE, Json, axis, is_tight, safe, short

_LEGEND_PX = 9  # of height for a series beyond the fourth: legends of many take rows
_BAND = "33"  # a fifth of the colour


def chart_figure(chart: Chart, colours: Colours) -> Json:
    """Returns data and layout of a chart."""
    made = {"bar": _bars, "histogram": _histogram}.get(chart.kind, _line)
    data = [
        trace
        for series in chart.series
        for trace in made(series, series.colour or colours[series.name], chart, colours)
    ]
    layout = BASE | {
        "height": 360 + _LEGEND_PX * max(0, len(chart.series) - 4),
        "showlegend": len(chart.series) > 1,
        "xaxis": axis(chart.x_label, is_log=chart.x_log) | _categories(chart),
        "yaxis": axis(chart.y_label, is_log=chart.y_log),
        "hovermode": "closest" if chart.kind in ("bar", "histogram") else "x unified",
    }
    if chart.kind == "bar":
        layout["barmode"] = "stack" if chart.stacked else "group"
    if chart.kind == "histogram":
        layout["barmode"] = "overlay"
    return {"data": data, "layout": layout}


def _categories(chart: Chart) -> Json:
    if chart.x_categories is None:
        return {}
    names = [safe(name) for name in chart.x_categories]
    angle = {"tickangle": -40} if is_tight(chart.x_categories) else {}
    return {"tickvals": list(range(len(names))), "ticktext": names, "showgrid": False, **angle}


def _line(series: Series, colour: str, chart: Chart, colours: Colours) -> list[Json]:
    dash = colours.dash(series.name) if series.colour is None else "solid"
    marks = {"points": "markers", "line+points": "lines+markers"}
    shape = "hv" if chart.kind == "steps" else "linear"
    y = (*series.y, *series.y[-1:]) if len(series.x) > len(series.y) else series.y
    trace = {
        "type": "scatter",
        "name": safe(series.name),
        "x": short(series.x),
        "y": short(y),
        "mode": marks.get(series.style, "lines"),
        "line": {
            "color": colour,
            "width": 1.8,
            "shape": shape,
            "dash": "dash" if series.style == "dashed" else dash,
        },
        "marker": {"color": colour, "size": 6},
        "hovertemplate": "%{y:.4~g}",
    }
    return [*_band(series, colour), trace]


def _band(series: Series, colour: str) -> list[Json]:
    """Returns a surface between low and high, in as many pieces as there are."""
    if series.low is None or series.high is None:
        return []
    x: list[float | int | None] = []
    y: list[float | int | None] = []
    rows = list(zip(series.x, series.low, series.high, strict=False))
    for whole, group in groupby(rows, key=lambda row: None not in row):
        piece = list(group) if whole else []
        x += [*(row[0] for row in piece), *(row[0] for row in reversed(piece)), None]
        y += [*(row[2] for row in piece), *(row[1] for row in reversed(piece)), None]
    return [
        {
            "type": "scatter",
            "x": short(x),
            "y": short(y),
            "fill": "toself",
            "fillcolor": colour + _BAND,
            "mode": "lines",
            "line": {"width": 0},
            "hoverinfo": "skip",
            "showlegend": False,
        }
    ]


def _bars(series: Series, colour: str, chart: Chart, _: Colours) -> list[Json]:
    trace: Json = {
        "type": "bar",
        "name": safe(series.name),
        "x": short(series.x),
        "y": short(series.y),
        "marker": {"color": colour},
        "hovertemplate": "%{y:.4~g}" if chart.x_categories is None else "%{x}: %{y:.4~g}",
    }
    if series.low is not None and series.high is not None:
        trace["error_y"] = {
            "type": "data",
            "symmetric": False,
            "array": short(_apart(series.high, series.y)),
            "arrayminus": short(_apart(series.y, series.low)),
            "color": palette.INK_FAINT,
            "thickness": 1.2,
        }
    return [trace]


def _apart(upper: Numbers, lower: Numbers) -> list[float | None]:
    return [
        None if a is None or b is None else float(a - b) for a, b in zip(upper, lower, strict=True)
    ]


def _histogram(series: Series, colour: str, chart: Chart, _: Colours) -> list[Json]:
    edges = list(pairwise(series.x))
    return [
        {
            "type": "bar",
            "name": safe(series.name),
            "x": short((low + high) / 2 for low, high in edges),
            "y": short(series.y),
            "width": short(high - low for low, high in edges),
            "marker": {"color": colour, "line": {"width": 0}},
            "opacity": 1.0 if len(chart.series) == 1 else 0.55,
            "hovertemplate": "%{x:.4~g}: %{y:.4~g}",
        }
    ]
