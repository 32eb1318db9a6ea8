"""A timeline as Plotly takes it."""

from __future__ import annotations

from studies.page.charts import Timeline
from studies.page.colours import Colours
from studies.page.layout import BASE, Json, axis, safe, short


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
