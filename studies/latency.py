"""How long each stage of a frame took."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from recorder.run import Run

STAGES = (
    "sense", "select", "encode", "link", "decode", "place", "wait", "merge", "ground", "detect",
    "fuse", "count", "decide", "actuate", "end_to_end",
)  # fmt: skip
"""The way of a frame; every summary names these, and further ones that a process measured."""

_PERCENTILES = (50, 95, 99)
_LONGEST_NS = 60_000_000_000
# A span that an agent or the edge did not measure itself follows from an upload's time stamps.
_FROM_UPLOADS = {
    "sense": "sense_end_ns - sense_start_ns",
    "encode": "encode_end_ns - sense_end_ns",
    "link": "received_ns - encode_end_ns",
    "decode": "decoded_ns - received_ns",
}


def latencies(run: Run) -> dict[str, dict[str, float | None]]:
    """Returns p50, p95 and p99 in ms by stage; None where nothing was measured.

    Differences that are negative or above a minute are left out: they compare the clocks of two
    machines.
    """
    durations = _durations(run)
    others = sorted(durations.keys() - set(STAGES))
    return {stage: _percentiles(durations.get(stage, [])) for stage in (*STAGES, *others)}


def _durations(run: Run) -> dict[str, list[int]]:
    durations: dict[str, list[int]] = defaultdict(list)
    for stage, duration_ns in run.query("SELECT stage, duration_ns FROM stages"):
        durations[stage].append(duration_ns)
    for stage, took in _FROM_UPLOADS.items():
        if stage not in durations:
            sql = f"SELECT {took} FROM uploads WHERE {took} BETWEEN 0 AND ?"
            durations[stage] = [ns for (ns,) in run.query(sql, _LONGEST_NS)]
    sql = "SELECT end_to_end_ns FROM frames WHERE end_to_end_ns IS NOT NULL"
    durations["end_to_end"] = [ns for (ns,) in run.query(sql)]
    return durations


def _percentiles(durations_ns: list[int]) -> dict[str, float | None]:
    if not durations_ns:
        return {f"p{p}": None for p in _PERCENTILES}
    values_ms = np.percentile(np.array(durations_ns, np.float64), _PERCENTILES) / 1e6
    return {f"p{p}": float(v) for p, v in zip(_PERCENTILES, values_ms, strict=True)}
