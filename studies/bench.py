"""Shared code of benchmarks: default cases, and tables whose numbers are never truncated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

FRAME_PERIOD_S = 0.1
WARM_UP_FRAMES = 10  # of standing sensors' backgrounds and of rates: not scored
SHARING = "sharing"  # without an edge
POLICY_CHOICES = (
    "full", "roi", "foreground", "voronoi", "power", "reap", "reap+roi", "reap+foreground",
    "objects", SHARING,
)  # fmt: skip
LINK_CHOICES = ("5mbit", "lte", "5g-urban")

_ANY_WIDTH = 1000


@dataclass(frozen=True, slots=True)
class JsonRow:
    """A row of a measurement; subclasses hold its figures."""

    def as_json(self) -> dict[str, Any]:
        """Returns its figures by stable keys."""
        return asdict(self)


def empty_table(
    heads: Iterable[str],
    *,
    title: str | None = None,
    left: int = 1,
    padding: tuple[int, int] | tuple[int, int, int, int] = (0, 1, 0, 0),
) -> Table:
    """Returns a table without rows; the first `left` columns are words, the others numbers."""
    table = Table(
        title=title, box=box.SIMPLE_HEAD, title_justify="left", padding=padding, pad_edge=False
    )
    for number, head in enumerate(heads):
        table.add_column(head, justify="left" if number < left else "right", no_wrap=True)
    return table


def print_whole(table: Table, console: Console) -> None:
    """Prints a table in its full width."""
    boundless = console.options.update(width=_ANY_WIDTH)
    table.width = console.measure(table, options=boundless).maximum
    console.print(table, crop=False)
