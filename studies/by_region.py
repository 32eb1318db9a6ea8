"""Figures of a run by junction and by region, for the summary of a city."""

from __future__ import annotations

from collections import Counter, defaultdict
from itertools import pairwise
from statistics import fmean, median
from typing import Any

from protocol.roadmap import RoadMap
from recording.run import Run
from recording.tables import TruthRow
from studies.ecvpr import FrameScore, lane_owners

Figures = dict[str, dict[str, Any]]

_REGIONS = """
    SELECT region, avg(agents) FROM region_frames WHERE agents IS NOT NULL GROUP BY region
"""
_LATENCIES = "SELECT region, end_to_end_ns FROM region_frames WHERE end_to_end_ns IS NOT NULL"
_SENT_BY_AGENT = "SELECT agent, total(payload_bytes) FROM uploads GROUP BY agent"
_SENT_BY_LANE = """
    SELECT truth.lane, total(payload_bytes) FROM uploads
    JOIN truth ON truth.frame = uploads.frame AND truth.vehicle = uploads.agent GROUP BY truth.lane
"""
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


def junctions_of_run(
    run: Run, scores: list[FrameScore], errors: dict[str, list[int]], duration_s: float
) -> Figures:
    """Returns by signal: E-CVPR, mean delay of a vehicle on its lanes, switches, count error, mbps.

    `mbps` is the payload of the CAVs on its lanes and of the posts at it, in Mbit/s, to whichever
    regions it went.

    Args:
        run: with its setup.
        scores: of its frames.
        errors: of its counts, by signal.
        duration_s: simulated time.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    road_map = run.setup.road_map
    delay_s, payload = _delays(run, road_map), _payload_bytes(run, road_map)
    switches: Counter[str] = Counter()
    for (tls, green), (other, after) in pairwise(run.query(_GREENS)):
        switches[tls] += tls == other and green != after
    shares = _detected_shares(scores)
    return {
        one.tls: {
            "e_cvpr": shares.get(one.tls),
            "delay_s": delay_s.get(one.tls),
            "switches": switches[one.tls],
            "count_error": fmean(map(abs, errors[one.tls])) if one.tls in errors else None,
            "mbps": payload[one.tls] * 8e-6 / duration_s if duration_s else None,
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


def _detected_shares(scores: list[FrameScore]) -> dict[str, float]:
    """Returns by signal the share of vehicles detected, over all frames together."""
    present, true = Counter[str](), Counter[str]()
    for one in scores:
        present.update(one.present_at)
        true.update(one.true_at)
    return {tls: true[tls] / count for tls, count in present.items()}


def _delays(run: Run, road_map: RoadMap) -> dict[str, float]:
    """Returns by signal the mean time in s that a vehicle lost on its lanes."""
    owners, period_s = lane_owners(road_map), float(run.scenario.get("frame_period_s", 0.1))
    limits_mps = {lane.id: lane.speed_mps for lane in road_map.lanes}
    lost: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for row in run.rows(TruthRow):
        limit_mps = limits_mps.get(row.lane)
        if limit_mps is not None:
            frames = max(0.0, 1.0 - row.speed_mps / limit_mps)
            lost[owners[row.lane]][row.vehicle] += frames
    return {tls: period_s * fmean(frames.values()) for tls, frames in lost.items()}


def _payload_bytes(run: Run, road_map: RoadMap) -> Counter[str]:
    """Returns by signal the payload of the CAVs on its lanes and of the posts at it."""
    owners, found = lane_owners(road_map), Counter[str]()
    for lane, sent in run.query(_SENT_BY_LANE):
        found[owners.get(lane, "")] += sent
    posts = {mount["id"]: mount.get("tls") for mount in run.scenario.get("roadside_mounts", [])}
    for agent, sent in run.query(_SENT_BY_AGENT):
        if agent in posts:
            found[posts[agent] or road_map.intersections[0].tls] += sent
    return found
