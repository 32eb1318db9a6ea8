"""The rows of the bench of looking on as a table for people."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from studies.bench import print_whole
from studies.bench_looking import LookingRow


def print_looking(rows: list[LookingRow], console: Console) -> None:
    """Prints a line for each way of looking on."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for head in ("looked on", "pairs", "frames/s alone", "left, %", "90 % interval"):
        table.add_column(head, justify="left" if head == "looked on" else "right")
    for row in rows:
        interval = f"{100 * row.low:.1f} to {100 * row.high:.1f}"
        share = f"{100 * row.share:.1f}"
        table.add_row(row.way, str(row.pairs), f"{row.alone_hz:.2f}", share, interval)
    print_whole(table, console)
    console.print(
        "alone: with nobody; left: median over pairs of stretches of the frame rate beside that of "
        "the same frames in another run",
        style="dim",
    )
