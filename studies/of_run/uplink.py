"""What agents sent."""

from __future__ import annotations

from collections import defaultdict

from recorder.run import Run
from studies import palette
from studies.bandwidth import by_agent
from studies.of_run.clock import Clock, over_time
from studies.page.charts import Chart, Series
from studies.page.model import Cell, Column, Section, Table, Text
from studies.thin import line

MOST_AGENTS = 8
MOST_ROWS = 15
_COLUMNS = (
    Column("agent"),
    Column("frames", "d"),
    Column("points / frame", ".0f"),
    Column("kB / frame", ".1f"),
    Column("Mbit/s", ".2f"),
    Column("Mbit/s by TCP", ".2f"),
)
_SENT = """
    SELECT agent, frame, sum(payload_bytes) FROM uploads
    WHERE payload_bytes IS NOT NULL GROUP BY agent, frame
"""


def uplink_section(run: Run, clock: Clock) -> Section:
    """Returns bytes per agent, over time and as a table."""
    sent: dict[str, dict[int, int]] = defaultdict(dict)
    for agent, frame, payload in run.query(_SENT):
        sent[agent][frame] = payload
    if not sent:
        return Section("Uplink", (Text("No agent sent anything, or nothing of it was recorded."),))
    return Section("Uplink", (*_charts(sent, clock), _table(run, clock)))


def most_active(agents: dict[str, int]) -> list[str]:
    """Returns the agents with the largest figure, at most `MOST_AGENTS`; ties go by name."""
    return sorted(agents, key=lambda agent: (-agents[agent], agent))[:MOST_AGENTS]


def _charts(sent: dict[str, dict[int, int]], clock: Clock) -> tuple[Chart, Chart]:
    named = most_active({agent: len(frames) for agent, frames in sent.items()})
    totals: dict[int, int] = defaultdict(int)
    for frames in sent.values():
        for frame, payload in frames.items():
            totals[frame] += payload
    order = range(min(totals), max(totals) + 1)
    total = _line("all together", totals, order, clock, palette.PLAIN)
    series = tuple(_line(agent, sent[agent], order, clock) for agent in named)
    notes = f"The {len(named)} agents that sent most often, of {len(sent)}."
    left = len(sent) > len(named)
    return (
        over_time("Sent per frame, all agents together", "kB", (total,)),
        over_time("Sent per frame, by agent", "kB", series, notes=notes if left else ""),
    )


def _line(
    name: str, sent: dict[int, int], order: range, clock: Clock, colour: str | None = None
) -> Series:
    kilobytes = [sent[frame] / 1e3 if frame in sent else None for frame in order]
    return line(name, [clock[frame] for frame in order], kilobytes, colour)


def _table(run: Run, clock: Clock) -> Table:
    found = by_agent(run, clock.period_s)
    order = sorted(found, key=lambda agent: (-(found[agent]["frames"] or 0), agent))
    rows = tuple(_row(agent, found[agent]) for agent in order[:MOST_ROWS])
    caption = "By agent, over the frames in which it sent"
    return Table(_COLUMNS, rows, caption + left_out(len(order)))


def left_out(agents: int) -> str:
    """Returns what a caption says of agents beyond `MOST_ROWS`."""
    left = agents - MOST_ROWS
    return f"; {left} more that sent less often are left out" if left > 0 else ""


def _row(agent: str, figures: dict[str, float | None]) -> tuple[Cell, ...]:
    size = figures["bytes_per_frame"]
    return (
        agent,
        figures["frames"],
        figures["points_per_frame"],
        size / 1e3 if size is not None else None,
        figures["mbps"],
        figures["wire_mbps"],
    )
