"""Attacks and how often they were found out, as a table for people."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from studies.bench_misbehaviour import HONEST, PlausibilityRow
from studies.whole_table import print_whole


def print_plausibility(rows: list[PlausibilityRow], console: Console) -> None:
    """Prints a line for each attack at each share of CAVs; honest agents first."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("what an agent says", no_wrap=True)
    for head in ("CAVs", "tried", "found", "after s", "others left out, s", "agent-hours"):
        table.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        is_honest = row.attack == HONEST
        table.add_row(
            "the truth" if is_honest else row.attack,
            f"{row.cav_rate:g}",
            "" if is_honest else str(row.tried),
            "" if is_honest else str(row.found),
            "" if row.after_s is None else f"{row.after_s:.1f}",
            f"{row.others_s:.1f}",
            f"{row.hours:.3f}",
        )
    print_whole(table, console)
    console.print(
        "found: left out within 6 s, after so long (median); others: honest agents, all together",
        style="dim",
    )
