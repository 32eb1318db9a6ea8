"""What the agents uploaded in a frame, as points in the map frame, few enough to be drawn."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from perception.arrays import Floats, Floats32
from protocol.codec import claimed_points, decode
from protocol.errors import CodecError
from protocol.geometry import SE3
from protocol.messages import Scan

MAX_POINTS = 50_000  # of a frame
MAX_AGENTS = 64
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """An agent's points (N, 3), and where its sensor stands (3,), both in the map frame."""

    agent: str
    points: Floats32
    sensor_m: Floats


def clouds(scans: Iterable[Scan], most_points: int = MAX_POINTS) -> list[Cloud]:
    """Returns a cloud per agent; of all points every n-th, so that no more than these are left.

    A chunk that cannot be read is left out.
    """
    by_agent: dict[str, list[Scan]] = defaultdict(list)
    for scan in scans:
        if scan.agent in by_agent or len(by_agent) < MAX_AGENTS:
            by_agent[scan.agent].append(scan)
    claimed = sum(claimed_points(scan.payload) for own in by_agent.values() for scan in own)
    step = max(1, -(-claimed // most_points))
    found = []
    for agent in sorted(by_agent):
        own = by_agent[agent]
        parts = [part for scan in own if (part := _placed(scan, step)) is not None]
        if parts:
            found.append(Cloud(agent, np.concatenate(parts), own[0].sensor_pose[:3].copy()))
    return found


def _placed(scan: Scan, step: int) -> Floats32 | None:
    try:
        points = decode(scan.payload).points
    except CodecError as error:
        _log.debug("chunk %d of %s is left out: %s", scan.chunk, scan.agent, error)
        return None
    map_SE3_sensor = SE3.from_pose(scan.sensor_pose)
    return map_SE3_sensor.apply(points[::step]).astype(np.float32)
