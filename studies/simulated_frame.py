"""A perceived frame of a run in this process: for programs that observe or control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from perception.arrays import Floats
from protocol.bus import Bus
from protocol.codec import decode
from protocol.geometry import SE3
from protocol.inbox import Envelope, Inbox
from protocol.messages import AgentPose, Detections, LaneCounts, Scan, Setup, SignalState, Truth
from protocol.topics import BusName

_TOPICS = {
    BusName.V2X: ("state", "pose", "scan", "detections", "lanes"),
    BusName.WORLD: ("truth",),
}


@dataclass(frozen=True, slots=True, eq=False)
class UploadedScan:
    """One chunk of an agent's scan as it went over the bus.

    `sensor_pose` (6,) is `map_SE3_sensor` as the agent estimates it: x, y, z in m, roll, pitch, yaw
    in rad.
    """

    agent: str
    region: str
    chunk: int
    sensor_pose: Floats
    payload: bytes

    def points(self) -> Floats:
        """Returns the points (N, 3) in the map frame, in m.

        Raises:
            CodecError: the payload is no scan.
        """
        decoded = decode(self.payload).points
        return SE3.from_pose(self.sensor_pose).apply(decoded.astype(np.float64))


def cloud_of(scans: list[UploadedScan]) -> Floats:
    """Returns the points (N, 3) of scans, map frame, in m; a chunk sent to two regions once."""
    once = {(scan.agent, scan.chunk): scan for scan in reversed(scans)}
    return np.concatenate([np.zeros((0, 3)), *(once[key].points() for key in sorted(once))])


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrame:
    """Data of a frame after perception, before the signals decide on it.

    Attributes:
        number: of the frame, from 0.
        sim_time_s: of the simulation, warm-up included.
        detections: by region; boxes (N, 7) in the map frame with tracks, speeds and lanes.
        counts: vehicles by lane, by signal.
        signals: the state of each signal.
        poses: that agents report of themselves.
        scans: that agents uploaded, by region, agent and chunk.
        truth: ground truth of all bodies; no part of the system receives it.
    """

    number: int
    sim_time_s: float
    detections: Mapping[str, Detections]
    counts: Mapping[str, LaneCounts]
    signals: Mapping[str, SignalState]
    poses: list[AgentPose]
    scans: list[UploadedScan]
    truth: Truth

    @property
    def boxes(self) -> Floats:
        """Detected boxes (N, 7) of all regions: x, y, z, length, width, height in m, yaw in rad."""
        found = [one.boxes.astype(np.float64) for _, one in sorted(self.detections.items())]
        return np.concatenate([np.zeros((0, 7)), *found])

    @property
    def upload_bytes(self) -> int:
        """Encoded size of all scans."""
        return sum(len(scan.payload) for scan in self.scans)

    def cloud(self) -> Floats:
        """Returns the points (N, 3) of all scans, map frame, in m."""
        return cloud_of(self.scans)


@dataclass(slots=True, eq=False)
class _Parts:
    """The received messages of the present frame."""

    signals: dict[str, SignalState] = field(default_factory=dict)
    detections: dict[str, Detections] = field(default_factory=dict)
    counts: dict[str, LaneCounts] = field(default_factory=dict)
    poses: dict[str, AgentPose] = field(default_factory=dict)
    scans: dict[tuple[str, str, int], UploadedScan] = field(default_factory=dict)
    truth: Truth | None = None


class FrameCollector:
    """Collects the messages of a lockstep run's present frame."""

    def __init__(self, setup: Setup) -> None:
        self.inbox = Inbox()
        self._regions = set(setup.scenario["regions"])
        self._signals = {one.tls for one in setup.road_map.intersections}
        self._frame = -1
        self._parts = _Parts()
        self.is_waiting = False
        """Whether a frame has begun and is not perceived yet."""

    def subscribe(self, bus: Bus, name: BusName) -> None:
        """Subscribes to the topics of a frame."""
        for topic in _TOPICS[name]:
            bus.subscribe(topic)

    def take(self) -> SimulatedFrame | None:
        """Handles received messages; returns the frame if they complete it."""
        while (item := self.inbox.get()) is not None:
            if isinstance(item, Envelope):
                self._add(item)
        if not self.is_waiting or not self._is_whole():
            return None
        self.is_waiting = False
        return self._frame_of(self._parts)

    def _add(self, item: Envelope) -> None:
        message, parts = item.message, self._parts
        if isinstance(message, SignalState) and message.frame != self._frame:
            self._frame, self.is_waiting = message.frame, True
            parts = self._parts = _Parts()
        if getattr(message, "frame", None) != self._frame:
            return
        match message:
            case SignalState():
                parts.signals[message.tls] = message
            case Detections():
                parts.detections[item.parts["region"]] = message
            case LaneCounts():
                parts.counts[message.tls] = message
            case AgentPose():
                parts.poses[message.agent] = message
            case Scan():
                region = item.parts["region"]
                parts.scans[region, message.agent, message.chunk] = UploadedScan(
                    agent=message.agent,
                    region=region,
                    chunk=message.chunk,
                    sensor_pose=message.sensor_pose,
                    payload=message.payload.tobytes(),
                )
            case Truth():
                parts.truth = message

    def _is_whole(self) -> bool:
        parts = self._parts
        return (
            parts.truth is not None
            and self._regions <= parts.detections.keys()
            and self._signals <= parts.counts.keys()
        )

    def _frame_of(self, parts: _Parts) -> SimulatedFrame:
        truth = parts.truth
        assert truth is not None
        return SimulatedFrame(
            number=self._frame,
            sim_time_s=truth.sim_time_ns / 1e9,
            detections=parts.detections,
            counts=parts.counts,
            signals=parts.signals,
            poses=[parts.poses[name] for name in sorted(parts.poses)],
            scans=[parts.scans[key] for key in sorted(parts.scans)],
            truth=truth,
        )
