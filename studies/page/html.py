"""A page as one HTML file that needs nothing else: no network, no other file."""

from __future__ import annotations

import json
from base64 import b64encode
from functools import cache
from importlib import resources
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from studies.page.cells import numeric, rows_of
from studies.page.charts import Chart, MapChart, Timeline
from studies.page.colours import Colours
from studies.page.layout import Json
from studies.page.map_traces import map_figure
from studies.page.model import Beside, Block, Code, Figure, Page, Picture, Table, Text
from studies.page.timeline_traces import timeline_figure
from studies.page.traces import chart_figure

_LISTED_FROM = 4  # sections, for a table of contents


def to_html(page: Page) -> str:
    """Returns the page; the same page gives the same text.

    Raises:
        OSError: a picture's file cannot be read.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(_part("page.html.j2"))
    writer = _Writer(Colours.of(page))
    sections = [
        {"id": f"s{number}", "title": one.title, "blocks": [writer.view(b) for b in one.blocks]}
        for number, one in enumerate(page.sections, 1)
    ]
    return template.render(
        page=page,
        sections=sections,
        contents=sections if len(sections) >= _LISTED_FROM else [],
        style=Markup(_part("page.css")),
        script=Markup(_part("page.js")),
        plotly=Markup(get_plotlyjs()) if writer.figures else "",
        figures=_embedded(writer.figures),
    )


class _Writer:
    """Blocks as the template takes them; charts get the ids c1, c2, ... in reading order."""

    def __init__(self, colours: Colours) -> None:
        self.figures: list[Json] = []
        self._colours = colours

    def view(self, block: Block) -> dict[str, Any]:
        """Returns a block's kind and what it shows."""
        if isinstance(block, Beside):
            return {"kind": "beside", "blocks": [self.view(one) for one in block.blocks]}
        if isinstance(block, Chart | MapChart | Timeline):
            return self._figure(block)
        if isinstance(block, Table):
            return {
                "kind": "table",
                "table": block,
                "rows": rows_of(block),
                "on_right": numeric(block),
            }
        if isinstance(block, Picture):
            return {"kind": "picture", "caption": block.caption, "data": _base64(block)}
        kinds = {Text: "text", Code: "code"}
        return {"kind": kinds[type(block)], "block": block}

    def _figure(self, block: Figure) -> dict[str, Any]:
        name = f"c{len(self.figures) + 1}"
        self.figures.append({"id": name, **_drawn(block, self._colours)})
        height = self.figures[-1]["layout"]["height"]
        return {"kind": "figure", "id": name, "figure": block, "height": height}


def _drawn(block: Figure, colours: Colours) -> Json:
    if isinstance(block, MapChart):
        return map_figure(block, colours)
    if isinstance(block, Timeline):
        return timeline_figure(block, colours)
    return chart_figure(block, colours)


def _embedded(figures: list[Json]) -> Markup:
    """Returns JSON that cannot end the script element it stands in."""
    text = json.dumps(figures, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def _base64(picture: Picture) -> str:
    return b64encode(picture.data()).decode("ascii")


@cache
def _part(name: str) -> str:
    return resources.files("studies.page").joinpath(name).read_text("utf-8")
