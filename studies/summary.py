"""A run in figures. The keys are stable; a figure that the run does not yield is None."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from protocol.errors import ConfigError
from recorder.run import Run
from recorder.tables import DropRow
from studies.bandwidth import by_agent, total_mbps
from studies.doubted import doubted
from studies.ecvpr import score
from studies.latency import clock_error_ms, latencies

Summary = dict[str, Any]

_VEHICLES = """
    SELECT (SELECT count(DISTINCT vehicle) FROM truth WHERE frame = (SELECT min(frame) FROM truth)),
           (SELECT count(*) FROM (SELECT vehicle FROM trips UNION SELECT vehicle FROM truth)),
           count(arrive_s), total(teleported) FROM trips
"""

_GREENS = "SELECT tls, state FROM phases WHERE stage = 'green' ORDER BY tls, frame"


def summarise(run_dir: Path) -> Summary:
    """Returns the figures of a run, be it whole, cut off or empty.

    Raises:
        ConfigError: the folder is no run.
    """
    with Run(run_dir) as run:
        period_s = float(run.scenario.get("frame_period_s", 0.1))
        return {
            "scenario": run.scenario.get("name"),
            "seed": run.scenario.get("seed"),
            "mode": run.scenario.get("mode"),
            "replay_of": (run.scenario.get("replay") or {}).get("tape"),
            "ended": run.meta.get("end_reason"),
            **_pace(run, period_s),
            "agents": by_agent(run, period_s),
            "doubted": doubted(run),
            "uplink_mbps": total_mbps(run, period_s),
            "latency_ms": latencies(run),
            "clock_error_ms": clock_error_ms(run),
            **_perception(run),
            "unknown_share": _unknown_share(run),
            **traffic_of(run),
            **_drops(run),
        }


def to_json(summary: Summary) -> str:
    """Returns the summary as JSON."""
    return json.dumps(summary, indent=2, allow_nan=False)


def _pace(run: Run, period_s: float) -> Summary:
    sql = """
        SELECT count(*), max(sim_time_ns) - min(sim_time_ns), max(tick_ns) - min(tick_ns),
               total(complete = 0) FROM frames WHERE tick_ns IS NOT NULL
    """
    frames, sim_ns, wall_ns, incomplete = run.query(sql)[0]
    return {
        "frames": frames,
        "frames_incomplete": int(incomplete),
        "sim_duration_s": round(sim_ns / 1e9 + period_s, 9) if frames else 0.0,
        "real_time_factor": sim_ns / wall_ns if wall_ns else None,
    }


def _perception(run: Run) -> Summary:
    try:
        scores = score(run)
    except ConfigError:  # killed before its setup was written, or moved without it
        scores = []
    rates = [s.e_cvpr for s in scores if s.e_cvpr is not None]
    mean, std = _mean_std(rates)
    return {
        "e_cvpr": {"mean": mean, "std": std},
        "detections_per_frame": {
            "true": _mean_std([s.true for s in scores])[0],
            "false": _mean_std([s.false for s in scores])[0],
            "present": _mean_std([s.present for s in scores])[0],
        },
    }


def _unknown_share(run: Run) -> float | None:
    """Returns the share of decisions for which some lane before the stop bar was not seen."""
    share: float | None = run.query("SELECT avg(unknown <> '') FROM requests")[0][0]
    return share


def traffic_of(run: Run) -> Summary:
    """Returns delay, vehicles and switches of phase."""
    at_start, seen, finished, teleported = run.query(_VEHICLES)[0]
    losses = run.query("SELECT time_loss_s FROM trips ORDER BY vehicle")
    waiting = run.meta.get("end_waiting")
    mean, std = _mean_std([loss_s for (loss_s,) in losses])
    greens = run.query(_GREENS)
    return {
        "delay_s": {"mean": mean, "std": std},
        "vehicles": {
            "at_start": at_start,
            "inserted": seen - at_start,
            "finished": finished,
            "teleported": int(teleported),
            "waiting": int(waiting) if waiting is not None else None,
        },
        "phases": {"switches": sum(a[0] == b[0] and a != b for a, b in pairwise(greens))},
    }


def _drops(run: Run) -> Summary:
    by_reason: dict[str, dict[str, int]] = {}
    for row in run.rows(DropRow):
        by_reason.setdefault(row.process, {})[row.reason] = row.times
    total = sum(sum(reasons.values()) for reasons in by_reason.values())
    return {"drops": total, "drops_by_reason": by_reason}


def _mean_std(values: list[float]) -> tuple[float, float] | tuple[None, None]:
    if not values:
        return None, None
    array = np.array(values, np.float64)
    return float(array.mean()), float(array.std())
