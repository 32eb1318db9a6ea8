"""Latency breakdown: duration of each stage of a frame, by percentile, over time, by agent."""

from __future__ import annotations

from collections import defaultdict
from typing import TypeAlias

import numpy as np

from recording.run import Run
from studies import palette
from studies.over_time import FrameClock, over_time, thinned_series
from studies.page.model import Block, Cell, Chart, Column, Section, Series, Table, Text
from studies.uplink import MAX_ROWS, most_active, omitted_agents

STAGES = (
    "sense", "select", "encode", "send", "link", "decode", "place", "wait", "check", "merge",
    "ground", "detect", "fuse", "border", "track", "count", "decide", "actuate", "other",
    "end_to_end",
)  # fmt: skip
"""Stages of a frame in order; a summary lists all of them, then others that were measured."""

_PERCENTILES = (50, 95, 99)
_BETWEEN_PROCESSES = ("send", "link", "wait", "other")
"""Stages that are computed from the reports of several processes."""


def latencies(run: Run) -> dict[str, dict[str, float | None]]:
    """Returns p50, p95 and p99 in ms by stage; None where nothing was measured.

    `send`, `link`, `wait` and `other` are taken over agents and frames, for the scans that were
    used; clocks of different machines are aligned. Over virtual links `link` is simulated time.
    """
    durations = _durations(run)
    others = sorted(durations.keys() - set(STAGES))
    return {stage: _percentiles(durations.get(stage, [])) for stage in (*STAGES, *others)}


def end_to_end_ms(run: Run, after_frame: int = 0) -> dict[str, float | None]:
    """Returns mean, p50, p95 and p99 of the end-to-end latency from a frame on."""
    sql = "SELECT end_to_end_ns FROM frames WHERE end_to_end_ns IS NOT NULL AND frame >= ?"
    return distribution_ms([ns for (ns,) in run.query(sql, after_frame)])


def distribution_ms(durations_ns: list[int]) -> dict[str, float | None]:
    """Returns mean, p50, p95 and p99; None where nothing was measured."""
    mean_ms = float(np.mean(durations_ns)) / 1e6 if durations_ns else None
    return {"mean": mean_ms, **_percentiles(durations_ns)}


def clock_error_ms(run: Run) -> float | None:
    """Returns the largest error of a latency between machines; 0 on one machine."""
    ((worst_ns,),) = run.query("SELECT max(clock_error_ns) FROM latency")
    return None if worst_ns is None else worst_ns / 1e6


def _durations(run: Run) -> dict[str, list[int]]:
    durations: dict[str, list[int]] = defaultdict(list)
    for stage, duration_ns in run.query("SELECT stage, duration_ns FROM stages"):
        durations[stage].append(duration_ns)
    for stage in _BETWEEN_PROCESSES:
        durations[stage] = [ns for (ns,) in run.query(f"SELECT {stage}_ns FROM latency")]
    sql = "SELECT end_to_end_ns FROM frames WHERE end_to_end_ns IS NOT NULL"
    durations["end_to_end"] = [ns for (ns,) in run.query(sql)]
    return durations


def _percentiles(durations_ns: list[int]) -> dict[str, float | None]:
    if not durations_ns:
        return {f"p{p}": None for p in _PERCENTILES}
    values_ms = np.percentile(np.array(durations_ns, np.float64), _PERCENTILES) / 1e6
    return {f"p{p}": float(v) for p, v in zip(_PERCENTILES, values_ms, strict=True)}


Latencies: TypeAlias = dict[str, dict[str, float | None]]
STAGE_GROUPS = {
    "on the agent": ("sense", "select", "encode"),
    "uplink": ("send", "link"),
    "decoding": ("decode", "place"),
    "waiting for other agents": ("wait",),
    "perception": ("check", "merge", "ground", "detect", "fuse", "border", "track", "count"),
    "decision": ("decide", "actuate"),
    "other": ("other",),
}
"""Groups of stages, for charts by agent."""

_SHOWN_PERCENTILES = (("p50", palette.PLAIN), ("p95", "#56b4e9"))
_END_TO_END = """
    SELECT frame, end_to_end_ns FROM frames WHERE end_to_end_ns IS NOT NULL ORDER BY frame
"""


def latency_section(run: Run, clock: FrameClock, found: Latencies) -> Section:
    """Returns latencies by stage, over time and by agent."""
    blocks: list[Block] = [_stage_chart(found)] if _measured_stages(found) else []
    took = run.query(_END_TO_END)
    if took:
        x, y = [clock[frame] for frame, _ in took], [ns / 1e6 for _, ns in took]
        one = (thinned_series("end to end", x, y, palette.PLAIN),)
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


def _measured_stages(found: Latencies) -> list[str]:
    return [s for s, figures in found.items() if s != "end_to_end" and figures["p50"] is not None]


def _stage_chart(found: Latencies) -> Chart:
    stages = _measured_stages(found)
    series = tuple(
        Series(p, tuple(range(len(stages))), tuple(found[s][p] for s in stages), colour=colour)
        for p, colour in _SHOWN_PERCENTILES
    )
    names = tuple(stage.replace("_", " ") for stage in stages)
    return Chart("By stage", "", "ms", series, kind="bar", x_categories=names)


def _by_agent(run: Run) -> list[Block]:
    means = ", ".join(
        f"avg({' + '.join(f'{s}_ns' for s in stages)}) / 1e6" for stages in STAGE_GROUPS.values()
    )
    rows = run.query(
        f"SELECT agent, count(*), {means}, avg(end_to_end_ns) / 1e6 FROM latency GROUP BY agent"
    )
    if not rows:
        return []
    frames = {agent: count for agent, count, *_ in rows}
    by_name = {agent: figures for agent, _, *figures in rows}
    named = most_active(frames)
    series = tuple(
        Series(group, tuple(range(len(named))), tuple(by_name[agent][i] for agent in named))
        for i, group in enumerate(STAGE_GROUPS)
    )
    chart = Chart("Mean by agent", "", "ms", series, "bar", x_categories=tuple(named), stacked=True)
    names = ("agent", "frames", *STAGE_GROUPS, "end to end")
    columns = tuple(Column(name, "" if name in ("agent", "frames") else ".1f") for name in names)
    order = sorted(rows, key=lambda row: (-row[1], row[0]))[:MAX_ROWS]
    caption = f"Mean by agent, ms{omitted_agents(len(rows))}"
    return [chart, Table(columns, tuple(map(tuple, order)), caption)]
