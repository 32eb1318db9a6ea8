"""Figures of a run by junction and by region, for the summary of a city."""

from __future__ import annotations

from collections import Counter, defaultdict
from itertools import pairwise
from statistics import fmean, median
from typing import Any

from protocol.errors import ConfigError
from recording.run import Run
from recording.tables import DetectionRow, TruthRow
from studies.count_error import counts_with_truth
from studies.ecvpr import EvaluationArea, by_frame, matched_vehicles

Figures = dict[str, dict[str, Any]]

_REGIONS = """
    SELECT region, avg(agents) FROM region_frames WHERE agents IS NOT NULL GROUP BY region
"""
_LATENCIES = "SELECT region, end_to_end_ns FROM region_frames WHERE end_to_end_ns IS NOT NULL"
_MEMBERS = "SELECT DISTINCT frame, agent, region FROM uploads ORDER BY agent, frame"
_GREENS = "SELECT tls, state FROM phases WHERE stage = 'green' ORDER BY tls, frame"


def regions_of_run(run: Run, duration_s: float) -> Figures:
    """Returns by region: agents a frame, Mbit/s of payload, median latency in ms, handovers.

    A handover is an agent that comes to a region while it belongs to another.
    """
    payload = dict(run.query("SELECT region, total(payload_bytes) FROM uploads GROUP BY region"))
    latency_ns: dict[str, list[int]] = defaultdict(list)
    for region, took_ns in run.query(_LATENCIES):
        latency_ns[region].append(took_ns)
    handovers = _handovers(run)
    return {
        region: {
            "agents": agents,
            "mbps": payload.get(region, 0.0) * 8e-6 / duration_s if duration_s else None,
            "latency_ms": median(latency_ns[region]) / 1e6 if latency_ns[region] else None,
            "handovers": handovers[region],
        }
        for region, agents in run.query(_REGIONS)
    }


def junctions_of_run(run: Run, period_s: float) -> Figures:
    """Returns by signal: E-CVPR, mean delay of a vehicle on its lanes, switches, count error."""
    switches: Counter[str] = Counter()
    for (tls, green), (other, after) in pairwise(run.query(_GREENS)):
        switches[tls] += tls == other and green != after
    try:
        road_map = run.setup.road_map
        detected, delay_s = _perceived(run, period_s)
        errors = _count_errors(run)
    except ConfigError:  # killed before its setup was written, or moved without it
        return {}
    return {
        one.tls: {
            "e_cvpr": detected.get(one.tls),
            "delay_s": delay_s.get(one.tls),
            "switches": switches[one.tls],
            "count_error": errors.get(one.tls),
        }
        for one in road_map.intersections
    }


def _handovers(run: Run) -> Counter[str]:
    found: Counter[str] = Counter()
    before: tuple[str, int, set[str]] = ("", -1, set())
    regions: dict[tuple[str, int], set[str]] = defaultdict(set)
    for frame, agent, region in run.query(_MEMBERS):
        regions[agent, frame].add(region)
    for (agent, frame), here in regions.items():  # by agent, then by frame
        if (agent, frame - 1) == before[:2]:
            found.update(here - before[2])
        before = (agent, frame, here)
    return found


def _perceived(run: Run, period_s: float) -> tuple[dict[str, float], dict[str, float]]:
    """Returns by signal the share of vehicles detected, and the mean time that one lost."""
    road_map = run.setup.road_map
    lanes, area = road_map.by_id, EvaluationArea(road_map)
    only = road_map.intersections[0].tls  # of lanes that no net has given an owner
    owner = {name: lane.tls or only for name, lane in lanes.items()}
    types = {kind.name: kind for kind in run.setup.vehicle_types}
    detections = dict(by_frame(run.rows(DetectionRow)))
    perceived = {n for (n,) in run.query("SELECT frame FROM frames WHERE detections IS NOT NULL")}
    present, seen = Counter[str](), Counter[str]()
    lost_s: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for frame, vehicles in by_frame(run.rows(TruthRow)):
        known = [vehicle for vehicle in vehicles if vehicle.lane in lanes]
        for one in known:
            lane = lanes[one.lane]
            slower = max(0.0, 1.0 - one.speed_mps / lane.speed_mps)
            lost_s[owner[one.lane]][one.vehicle] += slower * period_s
        if frame not in perceived:
            continue
        found = detections.get(frame, [])
        matched, _ = matched_vehicles(found, vehicles, types)
        matched |= {one.source for one in found}  # those that report themselves
        for one in known:
            if area.contains(one.lane, one.lane_position_m):
                present[owner[one.lane]] += 1
                seen[owner[one.lane]] += one.vehicle in matched
    shares = {tls: seen[tls] / count for tls, count in present.items()}
    return shares, {tls: fmean(lost.values()) for tls, lost in lost_s.items()}


def _count_errors(run: Run) -> dict[str, float]:
    """Returns by signal the mean absolute error of a lane's count."""
    errors: dict[str, list[int]] = defaultdict(list)
    for row, present in counts_with_truth(run):
        errors[row.tls].append(abs(row.vehicles - present))
    return {tls: fmean(found) for tls, found in errors.items()}
