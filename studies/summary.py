"""The summary of a run: its figures as a dictionary, as JSON, and as tables on one screen.

The keys are stable; a figure that the run does not yield is None.
"""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.columns import Columns
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from perception.detector import LIDAR
from protocol.errors import ConfigError
from protocol.messages import PEDESTRIAN, ObjectClass
from recording.run import Run
from recording.tables import DropRow
from studies.by_region import Figures, junctions_of_run, regions_of_run
from studies.coasting import coasting_score
from studies.count_error import count_errors
from studies.ecvpr import FrameScore, score
from studies.latency import STAGES, clock_error_ms, latencies
from studies.uplink import by_agent, total_mbps, wire_mbps

Summary = dict[str, Any]

_VEHICLES = f"""
    SELECT (SELECT count(DISTINCT vehicle) FROM truth
            WHERE frame = (SELECT min(frame) FROM frames) AND vehicle NOT GLOB '{PEDESTRIAN}*'),
           (SELECT count(*) FROM (SELECT vehicle FROM trips UNION SELECT vehicle FROM truth)
            WHERE vehicle NOT GLOB '{PEDESTRIAN}*'),
           count(arrive_s), total(teleported) FROM trips
"""
_AGENT_SCORES = """
    SELECT agent, min(score), total(trusted = 0) FROM agent_scores GROUP BY agent
    ORDER BY total(trusted = 0) DESC, min(score), agent
"""
_ALIGNMENTS = """
    SELECT agent, x_m, y_m, yaw_rad, std_m, max(frame) FROM alignments
    WHERE std_m < ? GROUP BY agent ORDER BY agent
"""
_CONTRADICTING = """
    SELECT agent, total(excluded) FROM alignments GROUP BY agent HAVING total(excluded) > 0
"""
_ALIGNED_STD_M = 0.5
_GREENS = "SELECT tls, state FROM phases WHERE stage = 'green' ORDER BY tls, frame"


def summarise(run_dir: Path) -> Summary:
    """Returns the figures of a run, be it whole, cut off or empty.

    Raises:
        ConfigError: the folder is no run.
    """
    with Run(run_dir) as run:
        return summary_of(run, scores_of(run))


def scores_of(run: Run) -> list[FrameScore]:
    """Returns the scores of a run's frames; none of a run that lacks its setup."""
    try:
        return score(run)
    except ConfigError:  # killed before its setup was written, or moved without it
        return []


def summary_of(run: Run, scores: list[FrameScore]) -> Summary:
    """Returns the figures of a run whose frames have these scores.

    Raises:
        ConfigError: the database is damaged.
    """
    period_s = float(run.scenario.get("frame_period_s", 0.1))
    pace = pace_of(run)
    return {
        "scenario": run.scenario.get("name"),
        "seed": run.scenario.get("seed"),
        "mode": run.scenario.get("mode"),
        "replay_of": (run.scenario.get("replay") or {}).get("recording"),
        "ended": run.meta.get("end_reason"),
        **pace,
        "agents": by_agent(run, period_s),
        "scores": agent_scores(run),
        "alignments": alignments(run),
        "uplink_mbps": total_mbps(run, period_s),
        "wire_mbps": wire_mbps(run, period_s),
        "latency_ms": latencies(run),
        "clock_error_ms": clock_error_ms(run),
        **_perception(scores),
        "found_per_frame": _found(run),
        "tracks": tracks_of(run),
        "unknown_share": _unknown_share(run),
        **traffic_of(run),
        "junctions": _junctions(run, scores, pace["sim_duration_s"]),
        "regions": regions_of_run(run, pace["sim_duration_s"]),
        **_drops(run),
    }


def to_json(summary: Summary) -> str:
    """Returns the summary as JSON."""
    return json.dumps(summary, indent=2, allow_nan=False)


def pace_of(run: Run) -> Summary:
    """Returns the number of frames, simulated time, and real-time factor."""
    period_s = float(run.scenario.get("frame_period_s", 0.1))
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


def _junctions(run: Run, scores: list[FrameScore], duration_s: float) -> Figures:
    try:
        return junctions_of_run(run, scores, count_errors(run), duration_s)
    except ConfigError:  # killed before its setup was written, or moved without it
        return {}


def _perception(scores: list[FrameScore]) -> Summary:
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


def _found(run: Run) -> dict[str, float] | None:
    """Returns how many objects of each class the LiDARs detected, per perceived frame.

    None of a run with truth, with which detections are compared instead.
    """
    if run.scenario.get("record", {}).get("truth", True):
        return None
    frames = run.query("SELECT count(*) FROM frames WHERE detections IS NOT NULL")[0][0]
    counts = dict(
        run.query(
            "SELECT object_class, count(*) FROM detections WHERE source = ? "
            "AND coasted_s = 0 GROUP BY object_class",
            LIDAR,
        )
    )
    if not frames:
        return None
    return {one.name.lower(): counts.get(int(one), 0) / frames for one in ObjectClass}


def tracks_of(run: Run) -> Summary | None:
    """Returns precision and E-CVPR with and without coasting tracks; None if there are none."""
    if not run.query("SELECT 1 FROM detections WHERE track > 0 LIMIT 1"):
        return None
    number = run.query("SELECT count(DISTINCT track) FROM detections WHERE track > 0")[0][0]
    try:
        score = coasting_score(run)
    except ConfigError:  # killed before its setup was written, or moved without it
        return {"tracks": number, "precision": None, "e_cvpr": None}
    return {"tracks": number, "precision": score.precision, "e_cvpr": score.ecvpr}


def _unknown_share(run: Run) -> float | None:
    """Returns the share of decisions for which some lane before the stop bar was not seen."""
    share: float | None = run.query("SELECT avg(unknown <> '') FROM requests")[0][0]
    return share


def traffic_of(run: Run) -> Summary:
    """Returns delay, vehicles and switches of phase."""
    at_start, seen, finished, teleported = run.query(_VEHICLES)[0]
    losses = [loss_s for (loss_s,) in run.query("SELECT time_loss_s FROM trips ORDER BY vehicle")]
    stops, co2_g = run.query("SELECT avg(stops), avg(co2_g) FROM trips")[0]
    waiting = run.meta.get("end_waiting")
    mean, std = _mean_std(losses)
    greens = run.query(_GREENS)
    return {
        "delay_s": {
            "mean": mean,
            "std": std,
            "p95": float(np.quantile(losses, 0.95)) if losses else None,
        },
        "stops": stops,
        "co2_g": co2_g,
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


_MAX_AGENTS = 8
_BLANK = "–"
_MANY = 0.2  # of a run's frames


def print_report(summary: Summary, console: Console) -> None:
    """Prints the summary; a figure that the run does not yield is a dash."""
    console.print(_headline(summary))
    console.print(Columns([_result_table(summary), _latency_table(summary)]))
    if summary["clock_error_ms"]:
        console.print(f"latencies between machines: ± {summary['clock_error_ms']:.2f} ms")
    if summary["agents"] or summary["scores"]:
        console.print(_agent_table(summary))
    if summary["drops"]:
        console.print(_drop_table(summary))
    if summary["frames_incomplete"] > _MANY * summary["frames"]:
        console.print(_why_incomplete(summary))


def _why_incomplete(summary: Summary) -> str:
    skipped = sum(of.get("skipped_ticks", 0) for of in summary["drops_by_reason"].values())
    if skipped > _MANY * summary["frames"]:
        return (
            f"Many frames were incomplete: agents had no time for {skipped} scans. This machine is "
            "too slow or too busy for the run: take a longer frame_period_s, fewer points "
            "(lidar.vehicle.points_per_second), or more cores."
        )
    return (
        "Many frames were incomplete: scans came later than edge.deadline_ms; a slow link needs a "
        "longer one, or agents that send less (upload.policy, upload.filters)."
    )


def _headline(summary: Summary) -> str:
    ended = summary["ended"] or "cut off"
    name = escape(str(summary["scenario"] or "run"))
    replayed = "; a replay: traffic and delay are the recording's" if summary["replay_of"] else ""
    return (
        f"[bold]{name}[/bold]  {summary['mode'] or ''}  "
        f"seed {summary['seed']}  [dim]({escape(ended)}{replayed})[/dim]"
    )


def _result_table(summary: Summary) -> Table:
    found = summary["found_per_frame"]
    facts = [
        ("frames", str(summary["frames"])),
        ("  incomplete", str(summary["frames_incomplete"])),
        ("simulated time", f"{summary['sim_duration_s']:.1f} s"),
        ("real-time factor", _number(summary["real_time_factor"], 2)),
    ]
    facts += _found_facts(found) if found is not None else _truth_facts(summary)
    facts += [
        ("phase switches", str(summary["phases"]["switches"])),
        ("drops", str(summary["drops"])),
    ]
    table = _numeric("result", "")
    for name, value in facts:
        table.add_row(name, value)
    return table


def _truth_facts(summary: Summary) -> list[tuple[str, str]]:
    """Returns the facts of traffic and perception."""
    vehicles, seen = summary["vehicles"], summary["detections_per_frame"]
    return [
        ("E-CVPR", _spread(summary["e_cvpr"], 100, 1, " %")),
        ("delay per vehicle", _spread(summary["delay_s"], 1, 1, " s")),
        ("  p95, s", _number(summary["delay_s"]["p95"], 1)),
        ("stops per vehicle", _number(summary["stops"], 2)),
        ("CO2 per vehicle, g", _number(summary["co2_g"], 0)),
        ("vehicles at frame 0", str(vehicles["at_start"])),
        ("  inserted", str(vehicles["inserted"])),
        ("  finished", str(vehicles["finished"])),
        ("  not inserted", _number(vehicles["waiting"], 0)),
        ("  teleported", str(vehicles["teleported"])),
        ("near the signal", _number(seen["present"], 1)),
        ("  truly detected", _number(seen["true"], 1)),
        ("  false detections", _number(seen["false"], 1)),
        *_track_facts(summary["tracks"]),
        ("with lanes unseen", _percent(summary["unknown_share"])),
    ]


def _found_facts(found: dict[str, float]) -> list[tuple[str, str]]:
    """Returns the facts shown instead of the comparison with the truth, where there is none."""
    by_class = [(f"  {name.replace('_', '-')}", _number(n, 1)) for name, n in found.items()]
    return [("detected a frame", _number(sum(found.values()), 1)), *by_class]


def _track_facts(tracks: Summary | None) -> list[tuple[str, str]]:
    """Returns the facts of tracks, if there are any."""
    if tracks is None or tracks["precision"] is None:
        return []
    precision, e_cvpr = tracks["precision"], tracks["e_cvpr"]
    return [
        ("tracks", str(tracks["tracks"])),
        ("  E-CVPR without coasting", _percent(e_cvpr["observed"])),
        ("  precision, observed", _percent(precision["observed"])),
        ("  precision, coasted", _percent(precision["coasted"])),
    ]


def _latency_table(summary: Summary) -> Table:
    table = _numeric("latency in ms", "p50", "p95", "p99")
    latency = summary["latency_ms"]
    for stage in (*STAGES, *(stage for stage in latency if stage not in STAGES)):
        style = None if stage in STAGES else "dim"
        style = "bold" if stage == "end_to_end" else style
        figures = [_number(latency[stage][p], 2) for p in ("p50", "p95", "p99")]
        table.add_row(stage.replace("_", " "), *figures, style=style)
    return table


def _agent_table(summary: Summary) -> Table:
    scores, aligned = summary["scores"], summary["alignments"]
    off = ["off m"] if aligned else []
    table = _numeric(
        "agent", "frames", "points", "kB/frame", "Mbit/s", "wire up", "down", "score", *off
    )
    agents = sorted(summary["agents"].items(), key=lambda item: (-item[1]["frames"], item[0]))
    for agent, figures in agents[:_MAX_AGENTS]:
        table.add_row(
            escape(agent),
            str(figures["frames"]),
            _number(figures["points_per_frame"], 0),
            _number(figures["bytes_per_frame"] / 1e3, 1),
            _number(figures["mbps"], 2),
            _number(figures["wire_mbps"], 2),
            _number(figures["wire_down_mbps"], 3),
            _score_text(scores.get(agent)),
            *[_off_text(aligned.get(agent)) for _ in off],
        )
    if len(agents) > _MAX_AGENTS:
        rest = agents[_MAX_AGENTS:]
        table.add_row(f"and {len(rest)} more", str(sum(a["frames"] for _, a in rest)))
    for agent in [name for name in scores if name not in summary["agents"]][:_MAX_AGENTS]:
        table.add_row(escape(agent), *[""] * 6, _score_text(scores[agent]))
    total, wire = summary["uplink_mbps"], summary["wire_mbps"]
    figures = (_number(total["mean"], 2), _number(wire["up"], 2), _number(wire["down"], 3))
    table.add_row("all together", "", "", "mean", *figures, style="bold")
    table.add_row("", "", "", "peak", _number(total["peak"], 2), style="bold")
    return table


def agent_scores(run: Run) -> dict[str, dict[str, float]]:
    """Returns by agent its least score and the number of frames it was excluded from, worst first.

    Agents that always had the full score are not among them.
    """
    return {
        agent: {"least_score": score, "frames_excluded": int(frames)}
        for agent, score, frames in run.query(_AGENT_SCORES)
    }


def alignments(run: Run) -> dict[str, dict[str, float]]:
    """Returns by agent the error of its poses when it was last aligned, in m and degrees.

    `contradicting` are the registered scans after which it was excluded. An agent whose offset was
    never found and that was never excluded is not among them.
    """
    found: dict[str, dict[str, float]] = {
        agent: {
            "x_m": x_m,
            "y_m": y_m,
            "yaw_deg": round(math.degrees(yaw_rad), 3),
            "std_m": std_m,
            "contradicting": 0,
        }
        for agent, x_m, y_m, yaw_rad, std_m, _ in run.query(_ALIGNMENTS, _ALIGNED_STD_M)
    }
    for agent, scans in run.query(_CONTRADICTING):
        found.setdefault(agent, {})["contradicting"] = int(scans)
    return found


def _off_text(found: dict[str, float] | None) -> str:
    if found is None or "x_m" not in found:
        return "-"
    return f"{math.hypot(found['x_m'], found['y_m']):.2f}"


def _score_text(found: dict[str, float] | None) -> str:
    if found is None:
        return "1.00"
    out = found["frames_excluded"]
    return f"{found['least_score']:.2f}" + (f", {out} excluded" if out else "")


def _drop_table(summary: Summary) -> Table:
    table = _numeric("dropped by", "times")
    for process, reasons in summary["drops_by_reason"].items():
        for reason, times in reasons.items():
            table.add_row(escape(f"{process}: {reason}"), str(times))
    return table


def _numeric(first: str, *others: str) -> Table:
    table = Table(first, box=box.SIMPLE_HEAD, pad_edge=False)
    for name in others:
        table.add_column(name, justify="right")
    return table


def _number(value: float | None, digits: int) -> str:
    return _BLANK if value is None else f"{value:.{digits}f}"


def _percent(share: float | None) -> str:
    return _BLANK if share is None else f"{100 * share:.1f} %"


def _spread(figures: dict[str, float | None], factor: float, digits: int, unit: str) -> str:
    mean, std = figures["mean"], figures["std"]
    if mean is None or std is None:
        return _BLANK
    return f"{mean * factor:.{digits}f} ± {std * factor:.{digits}f}{unit}"
