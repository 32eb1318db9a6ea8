"""The tracking stage: sight lines of sensors, and track ids passed from region to region.

It also keeps what signals show, and which agents are no longer trusted.
"""

from __future__ import annotations

import numpy as np

from edge_server.border import BorderStrips
from edge_server.frame import Chunk, FrameStage, FrameState
from perception.arrays import Floats
from perception.tracking.config import TrackingConfig
from perception.tracking.lane_graph import LaneGraph
from perception.tracking.sightlines import RING_M, RINGS, SightLines
from perception.tracking.tracker import Tracker
from perception.tracking.tracks import Tracks
from protocol.messages import BorderObjects, SignalState
from protocol.roadmap import RoadMap

REGION_BIT, FRAME_BIT = 50, 20
"""An id is the region's number, the frame in which its edge began, and a number from 1."""
REACH_M = RINGS * RING_M  # how far away an agent may have made up vehicles
STATES = 16  # of a signal that are kept
RECENT_FRAMES = 3  # after so many without a state the signal's state is unknown


class ShownSignals:
    """What signals have shown in the last frames.

    A frame's vehicles have moved under what was shown before it. So what counts is the state of an
    earlier frame, which has arrived for sure, in whatever order messages come.
    """

    def __init__(self) -> None:
        self._states: dict[str, dict[int, str]] = {}

    def note(self, state: SignalState) -> None:
        """Stores a signal's state of a frame."""
        states = self._states.setdefault(state.tls, {})
        states[state.frame] = state.state
        if len(states) > STATES:
            del states[min(states)]

    def before(self, frame: int) -> dict[str, str]:
        """Returns what each signal showed last before a frame."""
        shown: dict[str, str] = {}
        for tls, states in self._states.items():
            recent = [one for one in states if frame - RECENT_FRAMES <= one < frame]
            if recent:
                shown[tls] = states[max(recent)]
        return shown


class Track(FrameStage):
    """Stage that tracks vehicles from frame to frame.

    It begins with the first frame that an agent takes part in, and resets where time runs
    backwards: that frame is of a new run of the world.
    """

    name = "track"

    def __init__(
        self,
        road_map: RoadMap,
        config: TrackingConfig,
        strips: BorderStrips | None = None,
    ) -> None:
        self._config = config
        self._strips = strips
        leads_on = any(lane.successors for lane in road_map.lanes)  # else it is an open ground
        self._lanes = LaneGraph.of(road_map) if leads_on else None
        self._tracker: Tracker | None = None
        self._places: dict[str, Floats] = {}
        self._distrusted: set[str] = set()

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
        self._distrust(tracker, state)
        visible, signals = self._sight_lines(state), state.frame.signals
        try:
            tracks = tracker.step(time_ns, state.fused, visible, signals)
        except ValueError:
            state.drops["time_backwards"] += 1
            tracker.forget()
            tracks = tracker.step(time_ns, state.fused, visible, signals)
        state.drops["untracked"] += tracker.refused - refused
        return tracks

    def _distrust(self, tracker: Tracker, state: FrameState) -> None:
        """Distrusts tracks of agents that are excluded from this frame on; stores all positions."""
        new = state.distrusted - self._distrusted
        known = [self._places[name] for name in sorted(new) if name in self._places]
        if new:
            tracker.distrust(new, np.array(known).reshape(-1, 2), REACH_M)
        self._distrusted = set(state.distrusted)
        places = {pose.agent: pose.pose[:2] for pose in state.frame.poses}
        places |= {chunk.agent: chunk.sensor_pose[:2] for chunk in state.frame.chunks}
        self._places = places

    def _sight_lines(self, state: FrameState) -> SightLines | None:
        """Returns the sight lines of a frame's scans; None where agents sent boxes instead."""
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
        return SightLines.of(sensors, lowest)


def _tracks(message: BorderObjects) -> Tracks:
    """Returns the tracks in a neighbour's message."""
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
