"""Charts as data: no plotting library is known here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

ChartKind: TypeAlias = Literal["line", "bar", "histogram", "steps"]
Style: TypeAlias = Literal["line", "dashed", "points", "line+points"]
Mark: TypeAlias = Literal["disc", "cross", "diamond", "star"]
Number: TypeAlias = float | int
Numbers: TypeAlias = tuple[Number | None, ...]
Ring: TypeAlias = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Series:
    """One line or set of bars; where y is None there is a gap.

    `low` and `high` bound it: a band around a line, whiskers on a bar. Of a histogram, x are the
    edges, one more than the counts y. Without a colour it gets the one of its name on the page.
    """

    name: str
    x: tuple[Number, ...]
    y: Numbers
    low: Numbers | None = None
    high: Numbers | None = None
    style: Style = "line"
    colour: str | None = None

    def __post_init__(self) -> None:
        """Refuses lengths that do not fit together."""
        if len(self.x) - len(self.y) not in (0, 1):
            raise ValueError(f"{self.name}: {len(self.x)} x for {len(self.y)} y")
        if (self.low is None) != (self.high is None):
            raise ValueError(f"{self.name}: low and high come together")
        for bound in (self.low, self.high):
            if bound is not None and len(bound) != len(self.y):
                raise ValueError(f"{self.name}: {len(bound)} bounds for {len(self.y)} y")


@dataclass(frozen=True, slots=True)
class Chart:
    """Series over one x axis. With `x_categories`, x are places in them, from 0.

    Bars of several series stand side by side, or on each other if they are `stacked`.
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    kind: ChartKind = "line"
    x_log: bool = False
    y_log: bool = False
    x_categories: tuple[str, ...] | None = None
    stacked: bool = False
    notes: str = ""


@dataclass(frozen=True, slots=True)
class Points:
    """Points of one class on a map, in m; `hover` says what each is, or is empty."""

    name: str
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    hover: tuple[str, ...] = ()
    size: float = 5.0
    mark: Mark = "disc"
    colour: str | None = None


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
    """A bar of a timeline: on which row, from when to when, what it means."""

    row: str
    start: float
    end: float
    name: str


@dataclass(frozen=True, slots=True)
class Timeline:
    """What held when: bars on rows, coloured by what they mean."""

    title: str
    x_label: str
    rows: tuple[str, ...]
    spans: tuple[Span, ...]
    colours: tuple[tuple[str, str], ...] = ()
    notes: str = ""
