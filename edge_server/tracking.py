"""The stage that tracks: what sensors looked through, and ids that pass from region to region."""

from __future__ import annotations

import numpy as np

from edge_server.border import BorderStrips
from edge_server.frame import Chunk, FrameStage, FrameState
from perception.arrays import Floats
from perception.roadway import Roadway
from perception.tracking.config import TrackingConfig
from perception.tracking.lane_graph import LaneGraph
from perception.tracking.sightlines import SightLines
from perception.tracking.tracker import Tracker
from perception.tracking.tracks import Tracks
from protocol.messages import BorderObjects
from protocol.roadmap import RoadMap

REGION_BIT, FRAME_BIT = 50, 20
"""An id is the region's number, the frame in which its edge began, and a number from 1."""


class Track(FrameStage):
    """Follows vehicles from frame to frame: who is where, how fast, and still there if hidden.

    Begins with the first frame that an agent takes part in, and anew where time runs backwards:
    that frame's world is another one.
    """

    name = "track"

    def __init__(
        self,
        road_map: RoadMap,
        roadway: Roadway,
        config: TrackingConfig,
        strips: BorderStrips | None = None,
    ) -> None:
        self._config = config
        self._roadway = roadway
        self._strips = strips
        self._lanes = LaneGraph.of(road_map)
        self._tracker: Tracker | None = None

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        time_ns = state.frame.sim_time_ns
        if not self._config.enabled:
            state.tracks = Tracks.untracked(state.fused, time_ns)
            return
        if self._tracker is None and not state.frame.agents:
            state.tracks = Tracks.none()
            return
        if self._tracker is None:
            number = self._strips.number if self._strips is not None else 0
            first_id = (number << REGION_BIT) + (state.frame.frame << FRAME_BIT) + 1
            self._tracker = Tracker(self._config, self._lanes, first_id=first_id)
        state.tracks = self._step(self._tracker, state)

    def _step(self, tracker: Tracker, state: FrameState) -> Tracks:
        time_ns, refused = state.frame.sim_time_ns, tracker.refused
        for name in sorted(state.received):
            message = state.received[name]
            tracker.adopt(message.track_sim_time_ns, _tracks(message))
        visible = self._sight_lines(state)
        try:
            tracks = tracker.step(time_ns, state.fused, visible)
        except ValueError:
            state.drops["time_backwards"] += 1
            tracker.forget()
            tracks = tracker.step(time_ns, state.fused, visible)
        state.drops["untracked"] += tracker.refused - refused
        return tracks

    def _sight_lines(self, state: FrameState) -> SightLines | None:
        """Returns what the scans of a frame show; None where agents sent boxes instead."""
        if state.frame.found:
            return None
        chunks: dict[str, list[Chunk]] = {}
        for chunk in state.frame.chunks:
            if chunk.placed is not None and len(chunk.placed.lowest):
                chunks.setdefault(chunk.agent, []).append(chunk)
        sensors = np.array([parts[0].sensor_pose[:3] for parts in chunks.values()]).reshape(-1, 3)
        lowest = [
            np.concatenate([part.placed.lowest for part in parts if part.placed is not None])
            for parts in chunks.values()
        ]
        return SightLines.of(sensors, lowest, self._over_road_m(sensors, lowest))

    def _over_road_m(self, sensors: Floats, lowest: list[np.ndarray]) -> Floats:
        """Returns how high sensors are over the road that is nearest to each of them (P,)."""
        nearest = np.zeros((len(sensors), 2))
        for index, points in enumerate(lowest):
            x, y = points[:, 0] - sensors[index, 0], points[:, 1] - sensors[index, 1]
            nearest[index] = points[(x * x + y * y).argmin(), :2]
        return np.asarray(sensors[:, 2] - self._roadway.height_at(nearest))


def _tracks(message: BorderObjects) -> Tracks:
    """Returns the tracks that a neighbour told of."""
    number = len(message.track_ids)
    nothing = np.zeros(number)
    coasted_s = message.track_coasted_s.astype(np.float64)
    return Tracks(
        track_ids=message.track_ids.copy(),
        boxes=message.track_boxes.astype(np.float64),
        speeds_mps=message.track_speeds_mps.astype(np.float64),
        yaw_rates_rps=nothing,
        position_std_m=nothing,
        speed_std_mps=nothing,
        scores=np.ones(number),
        existence=np.full(number, 0.9),
        first_seen_ns=np.full(number, message.track_sim_time_ns)
        - np.round(message.track_ages_s * 1e9).astype(np.int64),
        coasted_s=coasted_s,
        classes=message.track_classes,
        sources=["lidar"] * number,
    )
