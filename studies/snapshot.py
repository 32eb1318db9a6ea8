"""One frame of a run, ready to be drawn: clouds, boxes, truth, counts and the signal."""

from __future__ import annotations

import logging
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from perception.arrays import Floats
from protocol.codec import decode
from protocol.errors import CodecError, ConfigError
from protocol.geometry import SE3
from protocol.roadmap import RoadMap
from recording.run import Run
from recording.tables import CloudRow, CountRow, DetectionRow, FrameRow, PhaseRow, TruthRow
from studies.ecvpr import EvaluationArea, FrameScore, parked_bodies, score_frame

_LISTED = 20
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class AgentCloud:
    """An agent's upload: points (N, 3) in the map frame, and its sensor's position."""

    agent: str
    points: Floats
    sensor_m: Floats
    payload_bytes: int


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Boxes as rows (N, 7): x, y, z of the centre, length, width, height, yaw."""

    values: Floats
    sources: list[str]


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Everything that a picture of one frame shows."""

    name: str
    road_map: RoadMap
    row: FrameRow
    clouds: list[AgentCloud]
    detections: Boxes
    truth: Boxes
    counts: dict[tuple[str, str], int]
    shown: dict[str, str]
    score: FrameScore


def load_snapshot(run: Run, frame: int | None) -> Snapshot:
    """Reads a frame whose uploads were recorded; of those the fullest if `frame` is None.

    Raises:
        ConfigError: no uploads of this frame were recorded, or the folder lacks its setup.
    """
    frame = _choose(run, frame)
    detections, truth = run.of_frame(DetectionRow, frame), run.of_frame(TruthRow, frame)
    rows = run.of_frame(FrameRow, frame)
    types = {kind.name: kind for kind in run.setup.vehicle_types}
    parked, area = parked_bodies(run.setup), EvaluationArea(run.setup.road_map)
    phases = run.of_frame(PhaseRow, frame)
    sized = [(t, types[t.type]) for t in truth if t.type in types]
    return Snapshot(
        name=str(run.scenario.get("name", "")),
        road_map=run.setup.road_map,
        row=rows[0] if rows else FrameRow(frame, *(None,) * 11),
        clouds=_clouds(run.of_frame(CloudRow, frame), {t.vehicle for t in truth}),
        detections=_boxes(
            [
                (d.x_m, d.y_m, d.z_m, d.length_m, d.width_m, d.height_m, d.yaw_rad)
                for d in detections
            ],
            [d.source for d in detections],
        ),
        truth=_boxes(
            [
                (t.x_m, t.y_m, t.z_m + k.height_m / 2, k.length_m, k.width_m, k.height_m, t.yaw_rad)
                for t, k in sized
            ],
            [t.vehicle for t, _ in sized],
        ),
        counts={(c.lane, c.side): c.vehicles for c in run.of_frame(CountRow, frame)},
        shown={phase.tls: phase.state for phase in phases},
        score=score_frame(frame, detections, truth + parked, types, area),
    )


def _choose(run: Run, frame: int | None) -> int:
    kept = [n for (n,) in run.query("SELECT DISTINCT frame FROM clouds ORDER BY frame")]
    if not kept:
        raise ConfigError(
            f"{run.dir} holds no scans to draw: no agent sent one in a frame that "
            "record.snapshot_period_s selects"
        )
    if frame is not None and frame not in kept:
        more = " …" if len(kept) > _LISTED else ""
        known = ", ".join(map(str, kept[:_LISTED])) + more
        raise ConfigError(f"{run.dir} holds no uploads of frame {frame}; it has {known}")
    return _fullest(run, kept) if frame is None else frame


def _fullest(run: Run, kept: list[int]) -> int:
    """Returns the frame with the most detections, the last of several."""
    found = dict(run.query("SELECT frame, COUNT(*) FROM detections GROUP BY frame"))
    return max(kept, key=lambda frame: (found.get(frame, 0), frame))


def _clouds(rows: list[CloudRow], vehicles: set[str]) -> list[AgentCloud]:
    """Returns a cloud per agent, roadside units first."""
    by_agent: dict[str, list[CloudRow]] = defaultdict(list)
    for row in rows:
        by_agent[row.agent].append(row)
    order = sorted(by_agent, key=lambda agent: (agent in vehicles, agent))
    return [_cloud(agent, by_agent[agent]) for agent in order]


def _cloud(agent: str, chunks: list[CloudRow]) -> AgentCloud:
    parts = [np.empty((0, 3))]
    for chunk in chunks:
        map_SE3_sensor = SE3.from_pose(_pose(chunk))
        try:
            parts.append(map_SE3_sensor.apply(decode(chunk.payload).points))
        except CodecError as error:
            _log.warning("chunk %d of %s is skipped: %s", chunk.chunk, agent, error)
    payload_bytes = sum(len(chunk.payload) for chunk in chunks)
    return AgentCloud(agent, np.concatenate(parts), _pose(chunks[0])[:3], payload_bytes)


def _pose(chunk: CloudRow) -> Floats:
    first = CloudRow._fields.index("sensor_x_m")
    return np.array(chunk[first : first + 6], np.float64)


def _boxes(rows: list[tuple[float, ...]], sources: list[str]) -> Boxes:
    return Boxes(np.array(rows, np.float64).reshape(-1, 7), sources)
