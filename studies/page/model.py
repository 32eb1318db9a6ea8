"""The content of a page: text, tables and charts, as data.

It is independent of any plotting library.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Literal, TypeAlias

from studies import palette

ChartKind: TypeAlias = Literal["line", "bar", "steps"]
Style: TypeAlias = Literal["line", "dashed", "line+points", "points"]
Mark: TypeAlias = Literal["disc", "cross", "star"]
Number: TypeAlias = float | int
Numbers: TypeAlias = tuple[Number | None, ...]
Ring: TypeAlias = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Series:
    """One line or set of bars; where y is None there is a gap.

    `low` and `high` bound it: a band around a line, whiskers on a bar. `points` are drawn too,
    several at each x. Without a colour it gets the one of its name on the page.
    """

    name: str
    x: tuple[Number, ...]
    y: Numbers
    low: Numbers | None = None
    high: Numbers | None = None
    style: Style = "line"
    colour: str | None = None
    points: tuple[Numbers, ...] = ()

    def __post_init__(self) -> None:
        """Refuses lengths that do not fit together."""
        if len(self.x) != len(self.y):
            raise ValueError(f"{self.name}: {len(self.x)} x for {len(self.y)} y")
        if (self.low is None) != (self.high is None):
            raise ValueError(f"{self.name}: low and high come together")
        if self.points and len(self.points) != len(self.x):
            raise ValueError(f"{self.name}: points at {len(self.points)} of {len(self.x)} x")
        for bound in (self.low, self.high):
            if bound is not None and len(bound) != len(self.y):
                raise ValueError(f"{self.name}: {len(bound)} bounds for {len(self.y)} y")


@dataclass(frozen=True, slots=True)
class Chart:
    """Series over one x axis. With `x_categories`, x are indices into them.

    Bars of several series are side by side, or on top of each other if `stacked`. `from_zero` has
    its axes begin at 0. A series without values is not drawn.
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    kind: ChartKind = "line"
    x_log: bool = False
    x_categories: tuple[str, ...] | None = None
    stacked: bool = False
    notes: str = ""
    from_zero: bool = False


@dataclass(frozen=True, slots=True)
class Points:
    """Points of one class on a map, in m; each with its label, or none has one."""

    name: str
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    size: float = 5.0
    mark: Mark = "disc"
    colour: str | None = None
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Outlines:
    """Closed shapes of one class, such as boxes; each is a ring of x, y in m."""

    name: str
    rings: tuple[Ring, ...]
    colour: str | None = None


@dataclass(frozen=True, slots=True)
class MapChart:
    """A plan with equal axes, in m: surfaces and lines of the road, outlines, points on top.

    `window` is what is shown at first: the lowest x and y, then the highest.
    """

    title: str
    surfaces: tuple[Ring, ...] = ()
    lines: tuple[Ring, ...] = ()
    points: tuple[Points, ...] = ()
    outlines: tuple[Outlines, ...] = ()
    window: tuple[float, float, float, float] | None = None
    notes: str = ""

    @property
    def aspect(self) -> float:
        """How high the window is, over its width."""
        left, low, right, high = self.window or (0.0, 0.0, 1.0, 0.6)
        return (high - low) / max(right - left, 1e-9)


@dataclass(frozen=True, slots=True)
class Span:
    """A bar of a timeline: row, start and end, state."""

    row: str
    start: float
    end: float
    name: str


@dataclass(frozen=True, slots=True)
class Timeline:
    """A timeline: bars on rows, coloured by state."""

    title: str
    x_label: str
    rows: tuple[str, ...]
    spans: tuple[Span, ...]
    colours: tuple[tuple[str, str], ...] = ()
    notes: str = ""


Cell: TypeAlias = str | float | int | None


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph, as it is: no markup is read in it."""

    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """Text whose lines and spaces count; `folded` hides it until it is opened."""

    text: str
    title: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name, and how its numbers are written, such as ".2f" or ",d"."""

    name: str
    form: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells; None is a dash. A format that does not fit a cell leaves it unchanged."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        """Refuses rows of another width than the head."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {len(row)} cells under {len(self.columns)} columns")


Figure: TypeAlias = Chart | MapChart | Timeline


@dataclass(frozen=True, slots=True)
class SideBySide:
    """Blocks next to each other where the page is wide enough, else one below the other."""

    blocks: tuple[Block, ...]


Block: TypeAlias = Text | Code | Table | Chart | MapChart | Timeline | SideBySide


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page under its own title."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Fact:
    """A headline figure as text, with its label."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Page:
    """A whole page, with `facts` at its top."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[Fact, ...] = ()

    def figures(self) -> list[Figure]:
        """Returns all charts in the order in which they are read."""
        return [
            block
            for section in self.sections
            for block in flattened(section.blocks)
            if isinstance(block, Chart | MapChart | Timeline)
        ]


def flattened(blocks: tuple[Block, ...]) -> list[Block]:
    """Returns blocks in one sequence, those side by side one after the other."""
    found: list[Block] = []
    for block in blocks:
        found += flattened(block.blocks) if isinstance(block, SideBySide) else [block]
    return found


DASH = "–"


def text_of_cell(cell: Cell, form: str) -> str:
    """Returns a cell as text; a format that does not fit leaves it unchanged."""
    if cell is None or cell != cell:  # noqa: PLR0124 - NaN, which is no figure either
        return DASH
    if isinstance(cell, str):
        return cell
    try:
        return format(cell, form or ("" if isinstance(cell, int) else ".6g"))
    except ValueError:
        return str(cell)


def text_rows(table: Table) -> list[list[str]]:
    """Returns a table's rows as text."""
    forms = [column.form for column in table.columns]
    return [
        [text_of_cell(cell, form) for cell, form in zip(row, forms, strict=True)]
        for row in table.rows
    ]


def numeric_columns(table: Table) -> list[bool]:
    """Returns for each column whether it holds numbers, to be aligned right."""
    return [
        any(row[i] is not None for row in table.rows)
        and not any(isinstance(row[i], str) for row in table.rows)
        for i in range(len(table.columns))
    ]


DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True, slots=True)
class Colours:
    """Colours by name; after eight in one chart they repeat, and lines are dashed differently."""

    numbers: dict[str, int]

    @classmethod
    def of(cls, page: Page) -> Colours:
        """Assigns each name, in reading order, the first colour that no neighbour has.

        Neighbours are in one chart. A name with a colour of its own is skipped.
        """
        neighbours: dict[str, set[str]] = {}
        for figure in page.figures():
            names = _names(figure)
            for name in names:
                neighbours.setdefault(name, set()).update(names)
        numbers: dict[str, int] = {}
        for name, others in neighbours.items():
            taken = {numbers[other] for other in others if other in numbers}
            numbers[name] = next(number for number in count() if number not in taken)
        return cls(numbers)

    def __getitem__(self, name: str) -> str:
        """Returns the colour as "#rrggbb"."""
        return palette.SERIES[self.numbers.get(name, 0) % len(palette.SERIES)]

    def dash(self, name: str) -> str:
        """Returns one of `DASHES`."""
        return DASHES[self.numbers.get(name, 0) // len(palette.SERIES) % len(DASHES)]


def _names(figure: Figure) -> list[str]:
    if isinstance(figure, Chart):
        return [one.name for one in figure.series if one.colour is None]
    if isinstance(figure, MapChart):
        found = [(one.name, one.colour) for one in figure.outlines]
        found += [(one.name, one.colour) for one in figure.points]
        return [name for name, colour in found if colour is None]
    if isinstance(figure, Timeline):
        known = dict(figure.colours)
        return [span.name for span in figure.spans if span.name not in known]
    return []
