"""A map as Plotly takes it."""

from __future__ import annotations

from collections.abc import Iterable

from studies import palette
from studies.page.charts import MapChart, Outlines, Points, Ring
from studies.page.colours import Colours
from studies.page.layout import BASE, Json, axis, safe, short

_MARKS = {"disc": "circle", "cross": "x-thin", "diamond": "diamond", "star": "star"}
_WIDTH_PX = 1000
FRAME_PX = 110  # what stands around the map


def map_figure(chart: MapChart, colours: Colours) -> Json:
    """Returns data and layout of a map; metres are as long on both axes."""
    data = [
        _rings(map(_left_turning, chart.surfaces))
        | {"fill": "toself", "fillcolor": palette.ROAD, "line": {"width": 0}},
        _rings(chart.lines) | {"line": {"width": 0.8, "color": palette.ROAD_EDGE}},
        *(_outlines(one, one.colour or colours[one.name]) for one in chart.outlines),
        *(_points(one, one.colour or colours[one.name]) for one in chart.points),
    ]
    x_axis, y_axis = axis("east, m"), axis("north, m")
    y_axis |= {"scaleanchor": "x", "scaleratio": 1}
    for one in (x_axis, y_axis):
        one |= {"constrain": "domain", "showgrid": False}
    if chart.window is not None:
        left, low, right, high = chart.window
        x_axis["range"], y_axis["range"] = short((left, right)), short((low, high))
    layout = BASE | {
        "height": min(max(round(_WIDTH_PX * chart.aspect) + FRAME_PX, 360), 760),
        "hovermode": "closest",
        "dragmode": "pan",
        "showlegend": True,
        "legend": BASE["legend"] | {"itemsizing": "constant"},
        "xaxis": x_axis,
        "yaxis": y_axis,
    }
    return {"data": data, "layout": layout, "aspect": chart.aspect, "frame": FRAME_PX}


def _points(points: Points, colour: str) -> Json:
    line = {"width": 1.4, "color": colour} if points.mark == "cross" else {"width": 0}
    return {
        "type": "scatter",
        "mode": "markers",
        "name": safe(points.name),
        "x": short(points.x_m),
        "y": short(points.y_m),
        "text": [safe(text) for text in points.hover],
        "hovertemplate": "%{text}" if points.hover else "%{x:.1f}, %{y:.1f}",
        "marker": {
            "color": colour,
            "size": points.size,
            "symbol": _MARKS[points.mark],
            "opacity": 0.55 if len(points.x_m) > 200 else 0.95,
            "line": line,
        },
    }


def _outlines(outlines: Outlines, colour: str) -> Json:
    closed = [(*ring, ring[0]) for ring in outlines.rings if ring]
    return _rings(closed) | {
        "name": safe(outlines.name),
        "showlegend": True,
        "line": {"width": 1.2, "color": colour},
    }


def _rings(rings: Iterable[Ring]) -> Json:
    """Returns one trace of many lines, with gaps between them."""
    x: list[float | None] = []
    y: list[float | None] = []
    for ring in rings:
        x += [*(point[0] for point in ring), None]
        y += [*(point[1] for point in ring), None]
    return {
        "type": "scatter",
        "mode": "lines",
        "x": short(x),
        "y": short(y),
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _left_turning(ring: Ring) -> Ring:
    """Returns a ring that turns left: where rings of one sense overlap, no hole is left."""
    around = zip(ring, (*ring[1:], *ring[:1]), strict=True)
    area = sum(a[0] * b[1] - b[0] * a[1] for a, b in around)
    return ring if area >= 0 else ring[::-1]
