"""What an upload policy on a link comes to: bytes, latency, and what is still seen and counted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from edge_server.lanes import LaneIndex, Place
from protocol.roadmap import RoadMap
from recorder.run import Run
from recorder.tables import CountRow, DetectionRow, TruthRow
from studies.bandwidth import by_agent
from studies.ecvpr import by_frame, matched_vehicles
from studies.latency import end_to_end_ms
from studies.reach import DOWNSTREAM_M, UPSTREAM_M, Reach

LEARNING_FRAMES = 10  # of standing sensors' backgrounds and of rates: not scored

Visible = Callable[[int], set[str]]


@dataclass(frozen=True, slots=True)
class UplinkRow:
    """One policy on one link. A figure that the run does not yield is None.

    `fps` are the scans of an agent that the edge used, per second; `recall_visible` is the share
    of the vehicles without a radio, seen by all agents together, that the edge detects;
    `count_error` the mean absolute error of a lane's count, in vehicles.
    """

    policy: str
    link: str
    agents: int
    bytes_per_frame: float | None
    mbps_per_agent: float | None
    latency_ms: dict[str, float | None]
    fps: float | None
    recall_visible: float | None
    count_error: float | None
    false_per_frame: float | None

    def as_json(self) -> dict[str, Any]:
        """Returns stable keys."""
        return asdict(self)


def row_of(run: Run, policy: str, link: str, visible: Visible, frame_period_s: float) -> UplinkRow:
    """Reads a row from a run."""
    sent = by_agent(run, frame_period_s)
    frames = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")[0][0]
    sizes = [
        float(one["bytes_per_frame"] or 0) * float(one["frames"] or 0) for one in sent.values()
    ]
    mean_bytes = sum(sizes) / (len(sizes) * frames) if sizes and frames else None
    recall, false = _recall(run, visible)
    return UplinkRow(
        policy=policy,
        link=link,
        agents=len(sent),
        bytes_per_frame=mean_bytes,
        mbps_per_agent=None if mean_bytes is None else mean_bytes * 8e-6 / frame_period_s,
        latency_ms=end_to_end_ms(run, after_frame=LEARNING_FRAMES),
        fps=_scans_per_s(run, frame_period_s),
        recall_visible=recall,
        count_error=_count_error(run),
        false_per_frame=false,
    )


def _scans_per_s(run: Run, frame_period_s: float) -> float | None:
    """Returns how many scans of an agent the edge used per second of simulated time."""
    sql = """
        SELECT count(*), count(DISTINCT agent) FROM
        (SELECT DISTINCT frame, agent FROM uploads WHERE received_ns IS NOT NULL AND frame >= ?)
    """
    used, agents = run.query(sql, LEARNING_FRAMES)[0]
    ticks = "SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL AND frame >= ?"
    frames = run.query(ticks, LEARNING_FRAMES)[0][0]
    return used / agents / frames / frame_period_s if agents and frames else None


def _recall(run: Run, visible: Visible) -> tuple[float | None, float | None]:
    """Returns the share of visible vehicles in reach that were detected, and false ones a frame."""
    reach, types = Reach(run.setup.road_map), {kind.name: kind for kind in run.setup.vehicle_types}
    found = dict(by_frame(run.rows(DetectionRow)))
    perceived = {n for (n,) in run.query("SELECT frame FROM frames WHERE detections IS NOT NULL")}
    seen = detected = frames = false = 0
    for frame, vehicles in by_frame(run.rows(TruthRow)):
        if frame < LEARNING_FRAMES or frame not in perceived:
            continue
        here = [v.vehicle for v in vehicles if reach.contains(v.lane, v.lane_position_m)]
        wanted = visible(frame) & set(here)
        matched, wrong = matched_vehicles(found.get(frame, []), vehicles, types)
        seen, detected = seen + len(wanted), detected + len(wanted & matched)
        frames, false = frames + 1, false + wrong
    return (detected / seen if seen else None), (false / frames if frames else None)


def _count_error(run: Run) -> float | None:
    """Returns the mean absolute error over frames and lanes, before and behind the stop bar."""
    true = _true_counts(run)
    errors = [
        abs(row.vehicles - true[row.frame][row.side].get(row.lane, 0))
        for row in run.rows(CountRow)
        if row.frame >= LEARNING_FRAMES and row.frame in true
    ]
    return float(np.mean(errors)) if errors else None


def _true_counts(run: Run) -> dict[int, dict[str, dict[str, int]]]:
    road_map: RoadMap = run.setup.road_map
    index, number = LaneIndex(road_map), {lane.id: i for i, lane in enumerate(road_map.lanes)}
    counts: dict[int, dict[str, dict[str, int]]] = defaultdict(dict)
    for frame, vehicles in by_frame(run.rows(TruthRow)):
        on_map = [v for v in vehicles if v.lane in number]
        place = Place(
            np.array([number[v.lane] for v in on_map], np.int64),
            np.array([v.lane_position_m for v in on_map], np.float64),
        )
        before, behind = index.count(place, upstream_m=UPSTREAM_M, downstream_m=DOWNSTREAM_M)
        counts[frame] = {"upstream": before, "downstream": behind}
    return counts
