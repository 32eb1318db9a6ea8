"""The edge's rows as a table for people: a line for each detector and number of agents."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from studies.bench_edge import STAGES, TOTAL, EdgeRow
from studies.whole_table import print_whole

_BESIDE = "reference"


def print_edge(rows: list[EdgeRow], console: Console) -> None:
    """Prints medians of all stages, then how many times as fast as `reference` each is."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("detector", no_wrap=True)
    heads = ["agents", "points", *(stage for stage in STAGES if stage != TOTAL)]
    for head in [*heads, "total", "p95", "MB", "x"]:
        table.add_column(head, justify="right", no_wrap=True)
    totals = {(row.detector, row.agents): row for row in rows if row.stage == TOTAL}
    for (detector, agents), total in totals.items():
        stages = {
            row.stage: row for row in rows if (row.detector, row.agents) == (detector, agents)
        }
        beside = totals.get((_BESIDE, agents))
        table.add_row(
            detector,
            str(agents),
            str(total.points),
            *(f"{stages[stage].ms_p50:.1f}" for stage in STAGES),
            f"{total.ms_p95:.1f}",
            f"{total.peak_mb:.0f}",
            f"{beside.ms_p50 / total.ms_p50:.1f}" if beside else "",
        )
    print_whole(table, console)
    console.print(
        "ms, medians of frames; decode and place are sums over threads, total is by the clock; "
        "MB: the most memory of its process; x: as fast as `reference`",
        style="dim",
    )
