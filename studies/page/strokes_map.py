"""How a map is drawn by matplotlib."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from studies import palette
from studies.page.charts import MapChart
from studies.page.colours import Colours

_MARKS = {"disc": "o", "cross": "x", "diamond": "D", "star": "*"}


def draw_map(chart: MapChart, axes: Axes, colours: Colours) -> list[str]:
    """Draws a map; returns what its legend says."""
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
            alpha=0.6 if len(points.x_m) > 200 else 0.95,
            label="-",
        )
    axes.autoscale_view()
    if chart.window is not None:
        left, low, right, high = chart.window
        axes.set(xlim=(left, right), ylim=(low, high))
    return [one.name for one in chart.outlines] + [one.name for one in chart.points]
