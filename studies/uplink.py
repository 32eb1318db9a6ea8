"""Uplink use of agents: bytes and rates, and the section of a run's page that shows them."""

from __future__ import annotations

from collections import defaultdict

from recording.run import Run
from studies import palette
from studies.over_time import FrameClock, over_time, thinned_series
from studies.page.model import Cell, Chart, Column, Section, Series, Table, Text

Figures = dict[str, float | None]

_PER_AGENT = """
    SELECT agent, count(DISTINCT frame), sum(points), sum(payload_bytes), sum(wire_bytes),
           sum(wire_received_bytes), count(DISTINCT CASE WHEN wire_bytes IS NOT NULL THEN frame END)
    FROM uploads WHERE payload_bytes IS NOT NULL GROUP BY agent ORDER BY agent
"""


def by_agent(run: Run, frame_period_s: float) -> dict[str, Figures]:
    """Returns by agent its frames, points and bytes per frame, and its rate in Mbit/s.

    The rate is that of the frames in which the agent sent something, at the run's frame rate: what
    its link must carry when the run keeps pace with the clock. `wire_*` is all bytes on the link,
    up, and down where the name says so, as IP packets: see `protocol.traffic`. None if the
    transport did not count them.
    """
    return {
        agent: {
            "frames": frames,
            "points_per_frame": points / frames,
            "bytes_per_frame": payload / frames,
            "mbps": _mbps(payload / frames, frame_period_s),
            "wire_bytes_per_frame": wire / counted if wire else None,
            "wire_mbps": _mbps(wire / counted, frame_period_s) if wire else None,
            "wire_down_mbps": _mbps(down / counted, frame_period_s) if wire else None,
        }
        for agent, frames, points, payload, wire, down, counted in run.query(_PER_AGENT)
    }


def total_mbps(run: Run, frame_period_s: float) -> Figures:
    """Returns mean and peak of what all agents together sent in a frame, as a rate."""
    sql = "SELECT sum(payload_bytes) FROM uploads WHERE payload_bytes IS NOT NULL GROUP BY frame"
    rates = [_mbps(sent, frame_period_s) for (sent,) in run.query(sql)]
    frames = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")[0][0]
    return {
        "mean": sum(rates) / frames if frames else None,
        "peak": max(rates, default=None),
    }


def scan_kilobytes(run: Run) -> Figures:
    """Returns mean and peak of the payload that an agent sends in a frame, in kB."""
    sizes = [payload / 1e3 for _, _, payload in run.query(_SENT)]
    return {"mean": sum(sizes) / len(sizes) if sizes else None, "peak": max(sizes, default=None)}


def wire_mbps(run: Run, frame_period_s: float) -> Figures:
    """Returns the mean rate of all agents' links together, up and down, with all headers."""
    frames = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")[0][0]
    up, down = run.query("SELECT sum(wire_bytes), sum(wire_received_bytes) FROM uploads")[0]
    if not frames or up is None:
        return {"up": None, "down": None}
    return {
        "up": _mbps(up / frames, frame_period_s),
        "down": _mbps(down / frames, frame_period_s),
    }


def _mbps(bytes_per_frame: float, frame_period_s: float) -> float:
    return bytes_per_frame * 8e-6 / frame_period_s


MAX_LINES = 8
MAX_ROWS = 15
_COLUMNS = (
    Column("agent"),
    Column("frames", "d"),
    Column("points / frame", ".0f"),
    Column("kB / frame", ".1f"),
    Column("payload, Mbit/s", ".2f"),
    Column("on the wire up, Mbit/s", ".2f"),
    Column("down, Mbit/s", ".3f"),
)
_SENT = """
    SELECT agent, frame, sum(payload_bytes) FROM uploads
    WHERE payload_bytes IS NOT NULL GROUP BY agent, frame
"""


def uplink_section(run: Run, clock: FrameClock) -> Section:
    """Returns bytes per agent, over time and as a table."""
    sent: dict[str, dict[int, int]] = defaultdict(dict)
    for agent, frame, payload in run.query(_SENT):
        sent[agent][frame] = payload
    if not sent:
        return Section("Uplink", (Text("No agent sent anything, or no upload was recorded."),))
    return Section("Uplink", (*_charts(sent, clock), _table(run, clock)))


def most_active(agents: dict[str, int]) -> list[str]:
    """Returns the agents with the largest figure, at most `MAX_LINES`; ties go by name."""
    return sorted(agents, key=lambda agent: (-agents[agent], agent))[:MAX_LINES]


def _charts(sent: dict[str, dict[int, int]], clock: FrameClock) -> tuple[Chart, Chart]:
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
    name: str, sent: dict[int, int], order: range, clock: FrameClock, colour: str | None = None
) -> Series:
    kilobytes = [sent[frame] / 1e3 if frame in sent else None for frame in order]
    return thinned_series(name, [clock[frame] for frame in order], kilobytes, colour)


def _table(run: Run, clock: FrameClock) -> Table:
    found = by_agent(run, clock.period_s)
    order = sorted(found, key=lambda agent: (-(found[agent]["frames"] or 0), agent))
    rows = tuple(_row(agent, found[agent]) for agent in order[:MAX_ROWS])
    caption = "By agent, over the frames in which it sent"
    return Table(_COLUMNS, rows, caption + omitted_agents(len(order)))


def omitted_agents(agents: int) -> str:
    """Returns the end of a caption: how many agents beyond `MAX_ROWS` are omitted."""
    left = agents - MAX_ROWS
    return f"; {left} more that sent less often are omitted" if left > 0 else ""


def _row(agent: str, figures: dict[str, float | None]) -> tuple[Cell, ...]:
    size = figures["bytes_per_frame"]
    return (
        agent,
        figures["frames"],
        figures["points_per_frame"],
        size / 1e3 if size is not None else None,
        figures["mbps"],
        figures["wire_mbps"],
        figures["wire_down_mbps"],
    )
