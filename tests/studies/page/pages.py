"""A page with one of everything, some of it hostile."""

from studies.page.model import (
    Chart,
    Code,
    Column,
    Fact,
    MapChart,
    Outlines,
    Page,
    Points,
    Section,
    Series,
    SideBySide,
    Span,
    Table,
    Text,
    Timeline,
)  # fmt: skip

HOSTILE = '</script><script>alert("$x^$")</script>'
SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (0.0, 2.0))


def charts() -> tuple[Chart, ...]:
    """Returns a chart of every kind."""
    x = (1.0, 2.0, 3.0, 4.0)
    banded = Series("_a", x, (1.0, None, 3.0, 10.0), (0.5, None, 2.0, 9.0), (2.0, None, 4.0, 11.0))
    bars = Series("b", (0, 1), (1.0, 2.0), (0.5, 1.5), (1.5, None))
    names = ("one", HOSTILE)
    return (
        Chart("Line", "x", "y", (banded, Series(HOSTILE, x, x, style="line+points"))),
        Chart("Log", "x", "y", (Series("b", x, x, style="dashed"),), x_log=True),
        Chart("Bars", "", "y", (bars, Series("_a", (0,), (1.0,))), "bar", x_categories=names),
        Chart("Stack", "", "y", (bars, bars), "bar", x_categories=names, stacked=True),
        Chart("Steps", "x", "y", (Series("_a", (0, 1, 2), (3, None, 1)),), "steps", notes=HOSTILE),
        Chart("Nothing", "x", "y", ()),
    )


def whole_page() -> Page:
    """Returns a page with every kind of block in it."""
    spans = (Span("A", 0, 5, "green"), Span(HOSTILE, 5, 9, "other"))
    lamps = Timeline("Lamps", "s", ("A", HOSTILE), spans, (("green", "#00ff00"),))
    places = MapChart(
        "Map",
        surfaces=(SQUARE, SQUARE[::-1]),
        lines=(SQUARE[:2],),
        points=(Points(HOSTILE, (1.0, 2.0), (1.0, 1.0), mark="cross"),),
        outlines=(Outlines("box", (SQUARE,)),),
        window=(-1, -1, 5, 3),
    )
    columns = (Column("name"), Column("n", ".2f"), Column("count", ",d"))
    rows = ((HOSTILE, 1.234, 1000), (None, None, None), ("nan", float("nan"), 2))
    return Page(
        HOSTILE,
        HOSTILE,
        (
            Section(
                "Text | one", (Text(HOSTILE), Code("a\n```\n<b>", HOSTILE), Code("x", "y", True))
            ),
            Section(HOSTILE, (Table(columns, rows, HOSTILE),)),
            Section("Charts", (SideBySide(charts()[:2]), *charts()[2:])),
            Section("Places", (lamps, places)),
        ),
        (Fact("speed", "3 m/s", "mean"), Fact(HOSTILE, HOSTILE)),
    )
