"""The rows of the uplink bench as a table for people."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from studies.bench_uplink import EMP_RATE_HZ, RateRow, UplinkRow

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
    """Prints a table of all rates, then how far each policy came."""
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
