"""Where the time of a frame went, by stage and by agent."""

from __future__ import annotations

from typing import TypeAlias

from recorder.run import Run
from studies import palette
from studies.of_run.clock import Clock, over_time
from studies.of_run.uplink import MOST_ROWS, left_out, most_active
from studies.page.charts import Chart, Series
from studies.page.model import Block, Cell, Column, Section, Table, Text
from studies.thin import line

Latencies: TypeAlias = dict[str, dict[str, float | None]]
GROUPS = {
    "on the agent": ("sense", "select", "encode"),
    "on the way": ("send", "link"),
    "opened, placed": ("decode", "place"),
    "waiting for others": ("wait",),
    "perception": ("merge", "ground", "detect", "fuse", "count"),
    "decision": ("decide", "actuate"),
    "other": ("other",),
}
"""Stages that are shown as one where there are many."""

_PERCENTILES = (("p50", palette.PLAIN), ("p95", "#56b4e9"))
_END_TO_END = """
    SELECT frame, end_to_end_ns FROM frames WHERE end_to_end_ns IS NOT NULL ORDER BY frame
"""


def latency_section(run: Run, clock: Clock, found: Latencies) -> Section:
    """Returns latencies by stage, over time and by agent."""
    blocks: list[Block] = [_stages(found)] if _measured(found) else []
    took = run.query(_END_TO_END)
    if took:
        x, y = [clock[frame] for frame, _ in took], [ns / 1e6 for _, ns in took]
        one = (line("end to end", x, y, palette.PLAIN),)
        blocks.append(over_time("From sensing to the signal", "ms", one))
    blocks += _by_agent(run)
    return Section("Latency", tuple(blocks) or (Text("No latency was measured."),))


def latency_table(found: Latencies) -> Table:
    """Returns p50, p95 and p99 of every stage that was measured."""
    columns = (Column("latency, ms"), *(Column(p, ".2f") for p in ("p50", "p95", "p99")))
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (stage.replace("_", " "), figures["p50"], figures["p95"], figures["p99"])
        for stage, figures in found.items()
    )
    return Table(columns, rows)


def _measured(found: Latencies) -> list[str]:
    return [s for s, figures in found.items() if s != "end_to_end" and figures["p50"] is not None]


def _stages(found: Latencies) -> Chart:
    stages = _measured(found)
    series = tuple(
        Series(p, tuple(range(len(stages))), tuple(found[s][p] for s in stages), colour=colour)
        for p, colour in _PERCENTILES
    )
    names = tuple(stage.replace("_", " ") for stage in stages)
    return Chart("By stage", "", "ms", series, kind="bar", x_categories=names)


def _by_agent(run: Run) -> list[Block]:
    means = ", ".join(
        f"avg({' + '.join(f'{s}_ns' for s in stages)}) / 1e6" for stages in GROUPS.values()
    )
    rows = run.query(
        f"SELECT agent, count(*), {means}, avg(end_to_end_ns) / 1e6 FROM account GROUP BY agent"
    )
    if not rows:
        return []
    frames = {agent: count for agent, count, *_ in rows}
    by_name = {agent: figures for agent, _, *figures in rows}
    named = most_active(frames)
    series = tuple(
        Series(group, tuple(range(len(named))), tuple(by_name[agent][i] for agent in named))
        for i, group in enumerate(GROUPS)
    )
    chart = Chart("Mean by agent", "", "ms", series, "bar", x_categories=tuple(named), stacked=True)
    names = ("agent", "frames", *GROUPS, "end to end")
    columns = tuple(Column(name, "" if name in ("agent", "frames") else ".1f") for name in names)
    order = sorted(rows, key=lambda row: (-row[1], row[0]))[:MOST_ROWS]
    caption = f"Mean by agent, ms{left_out(len(rows))}"
    return [chart, Table(columns, tuple(map(tuple, order)), caption)]
