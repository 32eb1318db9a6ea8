"""Border strips: the vehicles and sensors that neighbouring regions exchange.

Each edge publishes the vehicles that it found on the lanes that both regions know, and where its
sensors stand. Both sides of a border join the same vehicles in the same order, so that they get the
same result: which of them publishes and counts a vehicle is then decided by its lane.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from edge_server.config import FusionConfig
from edge_server.frame import FrameState
from edge_server.fusion import join
from perception.arrays import Bools, Floats
from perception.detector import Vehicles
from perception.roadway import Roadway
from protocol.messages import BorderObjects, Detections, Span
from protocol.regions import RegionMap, shared_lanes
from protocol.roadmap import RoadMap

BORDER = "border"
STRIP_M = 10.0
"""Margin of a strip around the lanes that two regions share, m: larger than a box's error."""
SENSORS_M = 120.0
"""Distance within which sensors are published, m: farther than a LiDAR detects reliably."""
MAX_KEPT_FRAMES = 8
"""Limit on the frames kept of a neighbour."""


class BorderStrips:
    """The strips between a region and its neighbours, by the neighbour's id."""

    def __init__(self, own: RegionMap, regions: Mapping[str, RegionMap]) -> None:
        shared = {n: shared_lanes(own, one) for n, one in regions.items() if n != own.id}
        lanes = {n: strip for n, strip in shared.items() if strip is not None}
        self._strips = {n: Roadway.of(strip, margin_m=STRIP_M) for n, strip in lanes.items()}
        self._boxes = [_box(strip) for strip in lanes.values()]
        self._centres = own.centres
        self._owned = {lane.id for lane in own.area.lanes if lane.tls in own.area.by_tls}
        self._last = _nothing()
        self.number = sorted(regions).index(own.id)
        """Number of the region, in the city."""

    @property
    def neighbours(self) -> list[str]:
        """The regions that share lanes with this one."""
        return list(self._strips)

    def message_of(self, state: FrameState) -> BorderObjects:
        """Returns the border message of a frame: vehicles and sensors at strips."""
        inside = np.zeros(len(state.fused), np.bool_)
        for strip in self._strips.values():
            inside |= strip.contains(state.fused.boxes)
        found = state.fused.take(inside)
        whole_m = state.sensors.places_m[state.sensors.numbers < 0]
        return BorderObjects(
            frame=state.frame.frame,
            sim_time_ns=state.frame.sim_time_ns,
            boxes=found.boxes.astype(np.float32),
            scores=found.scores.astype(np.float32),
            classes=found.classes,
            sources=found.sources,
            position_std_m=found.position_std_m.astype(np.float32),
            sensors=whole_m[self._is_near(whole_m)],
            **self._tracks(),
        )

    def note(self, last: Detections) -> None:
        """Stores the region's published tracks of the last frame, for the next message."""
        self._last = last

    def _tracks(self) -> dict[str, Any]:
        """Returns the tracks on lanes in the strips whose owner is this region, by field."""
        last = self._last
        inside = np.zeros(len(last.boxes), np.bool_)
        for strip in self._strips.values():
            inside |= strip.contains(last.boxes)
        owned = np.array([lane in self._owned for lane in last.lanes], np.bool_)
        chosen = np.flatnonzero(inside & owned & (last.track_ids > 0))
        return {
            "track_sim_time_ns": last.sim_time_ns,
            "track_ids": last.track_ids[chosen],
            "track_boxes": last.boxes[chosen],
            "track_classes": last.classes[chosen],
            "track_speeds_mps": last.speeds_mps[chosen],
            "track_coasted_s": last.coasted_s[chosen],
            "track_ages_s": last.ages_s[chosen],
        }

    def join(self, state: FrameState, config: FusionConfig) -> None:
        """Joins a frame with its neighbours' border messages; strips without one stay unknown."""
        received = {n: state.received[n] for n in sorted(state.received) if n in self._strips}
        parts = [_as_received(state.fused)]
        for name, message in received.items():
            vehicles = _vehicles(message)
            parts.append(vehicles.take(self._strips[name].contains(vehicles.boxes)))
        state.fused = join(parts, centres=self._centres, config=config)
        for message in received.values():
            state.sensors = state.sensors.and_whole(message.sensors)

    def _is_near(self, places: Floats) -> Bools:
        """Whether places (N, 2) are near any strip."""
        near = np.zeros(len(places), np.bool_)
        for low, high in self._boxes:
            near |= ((places >= low - SENSORS_M) & (places <= high + SENSORS_M)).all(axis=1)
        return near


class BorderExchange:
    """Exchange of border messages: the waiting frame, and messages of it and later ones.

    An absent neighbour is not waited for; its strip stays unknown.
    """

    def __init__(self, strips: BorderStrips) -> None:
        self._strips = strips
        self._alive: set[str] = set()
        self._received: dict[str, dict[int, BorderObjects]] = {n: {} for n in strips.neighbours}
        self._finished = -1
        self._since_ns = self._until_ns = 0
        self.state: FrameState | None = None

    @property
    def neighbours(self) -> list[str]:
        """The regions that share lanes with this one."""
        return self._strips.neighbours

    def note_edge(self, region: str, *, alive: bool) -> None:
        """Notes that a neighbour's edge appeared or vanished."""
        (self._alive.add if alive else self._alive.discard)(region)

    def take(self, region: str, message: BorderObjects) -> bool:
        """Stores a neighbour's border message; returns False if its frame is over."""
        if region not in self._received or message.frame <= self._finished:
            return False
        kept = self._received[region]
        kept[message.frame] = message
        while len(kept) > MAX_KEPT_FRAMES:
            del kept[max(kept) if message.frame == min(kept) else min(kept)]
        return True

    def begin(self, state: FrameState, wait_ns: int) -> BorderObjects:
        """Begins to wait for neighbours with a frame; returns the message to publish."""
        self.state = state
        self._since_ns = time.monotonic_ns()
        self._until_ns = self._since_ns + wait_ns
        return self._strips.message_of(state)

    def is_due(self, now_ns: int) -> bool:
        """Whether a frame waits, and all neighbours have answered or it timed out."""
        if self.state is None:
            return False
        frame = self.state.frame.frame
        awaited = [n for n in self._received if n in self._alive and frame not in self._received[n]]
        return not awaited or now_ns >= self._until_ns

    def end(self) -> FrameState:
        """Returns the frame that waited, with the received messages.

        Raises:
            ValueError: none waits.
        """
        if self.state is None:
            raise ValueError("no frame waits for its neighbours")
        state, self.state = self.state, None
        waited = Span(stage=BORDER, start_ns=self._since_ns, end_ns=time.monotonic_ns())
        state.spans.append(waited)
        frame = self._finished = state.frame.frame
        state.received = {n: kept[frame] for n, kept in self._received.items() if frame in kept}
        for kept in self._received.values():
            for past in [number for number in kept if number <= frame]:
                del kept[past]
        return state


def _box(strip: RoadMap) -> tuple[Floats, Floats]:
    points = np.concatenate([lane.points[:, :2] for lane in strip.lanes])
    return points.min(axis=0), points.max(axis=0)


def _as_received(vehicles: Vehicles) -> Vehicles:
    """Returns vehicles with numbers rounded as in a message, as the neighbours receive them."""
    return Vehicles(
        vehicles.boxes.astype(np.float32).astype(np.float64),
        vehicles.scores.astype(np.float32).astype(np.float64),
        vehicles.sources,
        vehicles.position_std_m.astype(np.float32).astype(np.float64),
        vehicles.classes,
        np.full((len(vehicles), 2), np.nan),
    )


def _vehicles(message: BorderObjects) -> Vehicles:
    return Vehicles(
        message.boxes.astype(np.float64),
        message.scores.astype(np.float64),
        message.sources,
        message.position_std_m.astype(np.float64),
        message.classes,
        np.full((len(message.boxes), 2), np.nan),
    )


def _nothing() -> Detections:
    """Returns the detections of an edge before its first frame."""
    empty = np.zeros(0, np.float32)
    return Detections(
        frame=0,
        sim_time_ns=0,
        agents=[],
        boxes=np.zeros((0, 7), np.float32),
        scores=empty,
        classes=np.zeros(0, np.uint8),
        lanes=[],
        distances_m=empty,
        sources=[],
        track_ids=np.zeros(0, np.int64),
        speeds_mps=empty,
        coasted_s=empty,
        ages_s=empty,
        position_std_m=empty,
        speed_std_mps=empty,
    )
