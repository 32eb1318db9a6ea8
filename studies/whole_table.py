"""Tables whose numbers are never cut: one that was would look like another number."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

_ANY_WIDTH = 1000


def print_whole(table: Table, console: Console) -> None:
    """Prints a table as wide as it is."""
    boundless = console.options.update(width=_ANY_WIDTH)
    table.width = console.measure(table, options=boundless).maximum
    console.print(table, crop=False)
