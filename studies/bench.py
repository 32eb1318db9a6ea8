"""What benches share: what they measure by default, and tables whose numbers are never cut."""

from __future__ import annotations

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


def print_whole(table: Table, console: Console) -> None:
    """Prints a table as wide as it is."""
    boundless = console.options.update(width=_ANY_WIDTH)
    table.width = console.measure(table, options=boundless).maximum
    console.print(table, crop=False)
