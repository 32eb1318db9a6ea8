"""`cpnet bench uplink` and `rate`: bytes, latency, detections and counts, by policy and link."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from recording.run import Run
from recording.tables import CountRow
from studies.bench import WARM_UP_FRAMES, JsonRow
from studies.count_error import PerceptionTally
from studies.frame_rows import FrameRows, perceived_by_frame
from studies.latency import end_to_end_ms
from studies.uplink import by_agent

EMP_LATENCY_MS, EMP_RATE_HZ = 93.0, 24.0  # published: mean end to end, frames a second
SUSTAINED_SHARE = 0.98  # of all frames

Visible = Callable[[int], set[str]]


@dataclass(frozen=True, slots=True)
class UplinkRow(JsonRow):
    """One policy on one link. A figure that the run does not yield is None.

    `fps` are the scans of an agent that the edge used, per second; `whole_fps` the complete frames:
    with `reap` not every agent's scan is needed; `recall_visible` is the share of the vehicles
    without a radio, seen by all agents together, that the edge detects; `count_error` the mean
    absolute error of a lane's count, in vehicles.
    """

    policy: str
    link: str
    agents: int
    bytes_per_frame: float | None
    mbps_per_agent: float | None
    latency_ms: dict[str, float | None]
    fps: float | None
    whole_fps: float | None
    recall_visible: float | None
    count_error: float | None
    false_per_frame: float | None


@dataclass(frozen=True, slots=True)
class RateRow(JsonRow):
    """One frame rate in realtime."""

    rate_hz: float
    uplink: UplinkRow

    @property
    def is_sustained(self) -> bool:
        """Whether nearly all frames were complete, and no queue grew: EMP's latency was kept."""
        mean_ms = self.uplink.latency_ms["mean"]
        whole = (self.uplink.whole_fps or 0.0) / self.rate_hz
        return whole >= SUSTAINED_SHARE and mean_ms is not None and mean_ms <= EMP_LATENCY_MS

    def as_json(self) -> dict[str, Any]:
        """Returns stable keys."""
        row = self.uplink.as_json()
        return {"rate_hz": self.rate_hz, "is_sustained": self.is_sustained, **row}


def row_of(
    run: Run, names: tuple[str, str], agents: int, visible: Visible, frame_period_s: float
) -> UplinkRow:
    """Reads a row from a run; `names` are policy and link."""
    policy, link = names
    sent = by_agent(run, frame_period_s)
    frames = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")[0][0]
    sizes = [
        float(one["bytes_per_frame"] or 0) * float(one["frames"] or 0) for one in sent.values()
    ]
    mean_bytes = sum(sizes) / (len(sizes) * frames) if sizes and frames else None
    tally = _tally(run, visible)
    return UplinkRow(
        policy=policy,
        link=link,
        agents=agents,
        bytes_per_frame=mean_bytes,
        mbps_per_agent=None if mean_bytes is None else mean_bytes * 8e-6 / frame_period_s,
        latency_ms=end_to_end_ms(run, after_frame=WARM_UP_FRAMES),
        fps=_scans_per_s(run, frame_period_s),
        whole_fps=_whole_per_s(run, frame_period_s),
        recall_visible=tally.recall_visible,
        count_error=tally.count_error,
        false_per_frame=tally.false_per_frame,
    )


def _scans_per_s(run: Run, frame_period_s: float) -> float | None:
    """Returns how many scans of an agent the edge used per second of simulated time."""
    sql = """
        SELECT (SELECT count(*) FROM (SELECT DISTINCT frame, agent FROM uploads
                WHERE received_ns IS NOT NULL AND frame >= ?)),
               (SELECT count(DISTINCT agent) FROM uploads)
    """
    used, agents = run.query(sql, WARM_UP_FRAMES)[0]
    ticks = "SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL AND frame >= ?"
    frames = run.query(ticks, WARM_UP_FRAMES)[0][0]
    return used / agents / frames / frame_period_s if agents and frames else None


def _whole_per_s(run: Run, frame_period_s: float) -> float | None:
    """Returns how many frames were complete per second of simulated time."""
    sql = """
        SELECT count(*), total(complete = 1) FROM frames WHERE tick_ns IS NOT NULL AND frame >= ?
    """
    frames, whole = run.query(sql, WARM_UP_FRAMES)[0]
    return whole / frames / frame_period_s if frames else None


def _tally(run: Run, visible: Visible) -> PerceptionTally:
    tally = PerceptionTally(run.setup)
    counts = FrameRows(run.rows(CountRow))
    for frame, found, vehicles in perceived_by_frame(run):
        if frame >= WARM_UP_FRAMES:
            tally.add(visible(frame), found, counts.of(frame), vehicles)
    return tally


_HEADS = (
    "policy", "kB", "Mbit/s", "mean", "p50", "p95", "p99", "scans/s", "seen %", "false", "count",
)  # fmt: skip


def print_uplink(rows: list[UplinkRow], console: Console) -> None:
    """Prints a table for each link."""
    for link in dict.fromkeys(row.link for row in rows):
        here = [row for row in rows if row.link == link]
        table = Table(
            title=f"{link}: {here[0].agents} agents, each",
            box=box.SIMPLE_HEAD,
            title_justify="left",
            padding=0,
            pad_edge=False,
        )
        for head in _HEADS:
            left = head == "policy"
            table.add_column(head, justify="left" if left else "right", no_wrap=left)
        for row in here:
            table.add_row(row.policy, *_figures(row))
        console.print(table)
    console.print(
        "kB, Mbit/s: payload of an agent's frame; mean to p99: ms from sensing to signal; scans/s: "
        "used, per agent; seen: of vehicles that all agents together hit with 5 points or more; "
        "false: detections of nothing, a frame; count: mean error of a lane, vehicles",
        style="dim",
    )


def print_rates(rows: list[RateRow], console: Console) -> None:
    """Prints a table of all rates, then the highest sustained rate of each policy."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for head in ("policy", "frames/s", "whole/s", "scans/s", "mean ms", "p95", "seen %", "kept up"):
        table.add_column(head, justify="left" if head == "policy" else "right")
    for row in rows:
        seen = row.uplink.recall_visible
        table.add_row(
            row.uplink.policy,
            f"{row.rate_hz:g}",
            _text(row.uplink.whole_fps, 1),
            _text(row.uplink.fps, 1),
            _text(row.uplink.latency_ms["mean"], 1),
            _text(row.uplink.latency_ms["p95"], 1),
            _text(None if seen is None else 100 * seen, 1),
            "yes" if row.is_sustained else "no",
        )
    console.print(table)
    for policy in dict.fromkeys(row.uplink.policy for row in rows):
        kept = [row.rate_hz for row in rows if row.uplink.policy == policy and row.is_sustained]
        best_hz = max(kept, default=0.0)
        console.print(
            f"{policy}: up to {best_hz:g} frames/s with {rows[0].uplink.agents} agents, "
            f"{best_hz / EMP_RATE_HZ:.2f} of EMP's {EMP_RATE_HZ:g}",
            markup=False,
        )


def _figures(row: UplinkRow) -> list[str]:
    kilobytes = None if row.bytes_per_frame is None else row.bytes_per_frame / 1e3
    seen = None if row.recall_visible is None else 100 * row.recall_visible
    latencies = [_text(row.latency_ms[key], 1) for key in ("mean", "p50", "p95", "p99")]
    return [
        _text(kilobytes, 1),
        _text(row.mbps_per_agent, 2),
        *latencies,
        _text(row.fps, 1),
        _text(seen, 1),
        _text(row.false_per_frame, 1),
        _text(row.count_error, 2),
    ]


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
