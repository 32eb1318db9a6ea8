"""Charts as Plotly takes them: traces and a layout, as plain JSON values."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from itertools import groupby, pairwise
from typing import Any

from studies import palette
from studies.page.charts import Chart, Numbers, Series, Timeline
from studies.page.colours import Colours

Json = dict[str, Any]
_LEGEND_PX = 9  # of height for a series beyond the fourth: legends of many take rows
_BAND = "33"  # a fifth of the colour
_MOST_FLAT = 70  # letters
BASE: Json = {
    "font": {"family": "system-ui, sans-serif", "size": 13, "color": palette.INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "margin": {"l": 60, "r": 34, "t": 12, "b": 50},
    "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)"},  # in the margin on the right
    "legend": {
        "orientation": "h",
        "x": 0,
        "y": 1.02,
        "yanchor": "bottom",
        "traceorder": "normal",
    },
    "hoverlabel": {"namelength": -1},
}


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


def timeline_figure(timeline: Timeline, colours: Colours) -> Json:
    """Returns data and layout of a timeline; the first row is on top."""
    known, place = dict(timeline.colours), {row: i for i, row in enumerate(timeline.rows)}
    data = []
    for name in dict.fromkeys(span.name for span in timeline.spans):
        spans = [span for span in timeline.spans if span.name == name]
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "name": safe(name),
                "base": short(span.start for span in spans),
                "x": short(span.end - span.start for span in spans),
                "y": [place[span.row] for span in spans],
                "customdata": short(span.end for span in spans),
                "width": 0.6,
                "marker": {"color": known.get(name) or colours[name], "line": {"width": 0}},
                "hovertemplate": "%{base:.1f} to %{customdata:.1f}",
            }
        )
    ticks = {"tickvals": list(place.values()), "ticktext": [safe(row) for row in place]}
    layout = BASE | {
        "height": 110 + 44 * len(place),
        "barmode": "overlay",
        "hovermode": "closest",
        "showlegend": True,
        "xaxis": axis(timeline.x_label) | {"range": _extent(timeline)},
        "yaxis": axis("") | ticks | {"autorange": "reversed", "showgrid": False},
    }
    return {"data": data, "layout": layout}


def _extent(timeline: Timeline) -> list[float | int | None] | None:
    if not timeline.spans:
        return None
    starts, ends = zip(*((span.start, span.end) for span in timeline.spans), strict=True)
    return short((min(starts), max(ends)))


def axis(label: str, *, is_log: bool = False) -> Json:
    """Returns an axis; its labels always find room."""
    return {
        "title": {"text": safe(label), "standoff": 8},
        "type": "log" if is_log else "linear",
        "automargin": True,
        "gridcolor": palette.GRID,
        "linecolor": palette.GRID,
        "zeroline": False,
    }


def safe(text: str) -> str:
    """Returns text that shows as it is: Plotly reads a kind of HTML."""
    return escape(text, quote=False)


def is_tight(names: tuple[str, ...]) -> bool:
    """Tells whether the names of categories would run into each other."""
    return len(names) * (max(map(len, names), default=0) + 2) > _MOST_FLAT


def short(values: Iterable[float | int | None]) -> list[float | int | None]:
    """Returns numbers with as many digits as can be seen; what is not finite is a gap."""
    return [_short(value) for value in values]


def _short(value: float | int | None) -> float | int | None:
    if value is None or not abs(value) < float("inf"):
        return None
    return value if isinstance(value, int) else float(f"{value:.7g}")


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
