"""How long each stage of a frame took."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from recorder.run import Run

STAGES = (
    "sense", "select", "encode", "send", "link", "decode", "place", "wait", "merge", "ground",
    "detect", "fuse", "count", "decide", "actuate", "other", "end_to_end",
)  # fmt: skip
"""The way of a frame; every summary names these, and further ones that a process measured."""

_PERCENTILES = (50, 95, 99)
_FROM_ACCOUNT = ("send", "link", "wait", "other")
"""What no single process can measure: it follows from what several of them said."""


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
    """Returns how wrong a latency between machines may be at most; 0 on one machine."""
    ((worst_ns,),) = run.query("SELECT max(clock_error_ns) FROM account")
    return None if worst_ns is None else worst_ns / 1e6


def _durations(run: Run) -> dict[str, list[int]]:
    durations: dict[str, list[int]] = defaultdict(list)
    for stage, duration_ns in run.query("SELECT stage, duration_ns FROM stages"):
        durations[stage].append(duration_ns)
    for stage in _FROM_ACCOUNT:
        durations[stage] = [ns for (ns,) in run.query(f"SELECT {stage}_ns FROM account")]
    sql = "SELECT end_to_end_ns FROM frames WHERE end_to_end_ns IS NOT NULL"
    durations["end_to_end"] = [ns for (ns,) in run.query(sql)]
    return durations


def _percentiles(durations_ns: list[int]) -> dict[str, float | None]:
    if not durations_ns:
        return {f"p{p}": None for p in _PERCENTILES}
    values_ms = np.percentile(np.array(durations_ns, np.float64), _PERCENTILES) / 1e6
    return {f"p{p}": float(v) for p, v in zip(_PERCENTILES, values_ms, strict=True)}
