"""Turns what was heard into Foxglove's messages, as far as there is time beside the taping."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from protocol import messages as m
from protocol.codec import decode
from protocol.courtesy import Budget
from protocol.errors import CodecError, ProtocolError
from protocol.inbox import Envelope
from tape import shapes
from tape.writer import TapeWriter

SHARE_PER_CORE = 0.01
"""Of the machine: so much of a core's time, for each core, may clouds take."""
MAX_OPEN_FRAMES = 8
MAX_FRAME_BYTES = 64 << 20
_DRAWN = frozenset({"pose", "scan", "truth", "detections"})
_V2X, _WORLD = "foxglove/v2x", "foxglove/world"  # topics of what agents say, and of the truth


@dataclass(slots=True)
class _Frame:
    """What was heard of a frame so far."""

    poses: dict[str, m.AgentPose] = field(default_factory=dict)
    scans: defaultdict[str, list[m.Scan]] = field(default_factory=lambda: defaultdict(list))
    truth: m.Truth | None = None
    detections: m.Detections | None = None
    sim_time_ns: int = 0
    heard_ns: int = 0
    size_bytes: int = 0


class Scene:
    """Converts the newest frame that is whole; older ones are left out.

    Boxes and poses are cheap and come first. Clouds cost about as much as the edge's own decoding:
    they have a budget, and while those of one frame are made others are left without.
    """

    def __init__(self, setup: m.Setup, writer: TapeWriter, budget: Budget) -> None:
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._road_map = setup.road_map
        self._writer = writer
        self._budget = budget
        self._open: dict[int, _Frame] = {}
        self._seen = -1
        self._due: _Frame | None = None
        self._now = _Frame()
        self._clouds: list[str] = []
        self._drawn_in = 0
        self.frames_left_out = 0
        self.clouds_left_out = 0

    def take(self, item: Envelope) -> None:
        """Notes a message; a frame is due once the edge has said what it sees in the next one."""
        message = _drawn(item)
        if not isinstance(message, m.AgentPose | m.Scan | m.Truth | m.Detections):
            return
        frame = self._frame(message.frame)
        if frame.size_bytes + len(item.data) > MAX_FRAME_BYTES:
            return
        frame.size_bytes += len(item.data)
        frame.heard_ns = frame.heard_ns or item.received_ns
        frame.sim_time_ns = message.sim_time_ns
        if isinstance(message, m.AgentPose):
            frame.poses[message.agent] = message
        elif isinstance(message, m.Scan):
            frame.scans[message.agent].append(message)
        elif isinstance(message, m.Truth):
            frame.truth = message
        else:
            frame.detections = message
            self._close(message.frame)

    def step(self) -> bool:
        """Does a little, a few milliseconds at most: the boxes of a frame, or a cloud.

        Returns whether there was anything to do.
        """
        if self._due is not None:
            self._convert(self._due)
            self._begin_clouds(self._due)
            self._due = None
            return True
        if self._clouds:
            start_ns = time.thread_time_ns()
            self._convert_cloud(self._clouds.pop())
            self._budget.spend(time.thread_time_ns() - start_ns)
            return True
        return False

    def _close(self, number: int) -> None:
        """Makes the frame before this one due: what is prompt may overtake the scans of its own."""
        ready = self._open.pop(self._seen, None)
        self._seen = number
        if ready is not None:
            self.frames_left_out += self._due is not None
            self._due = ready

    def _frame(self, number: int) -> _Frame:
        if number not in self._open:
            while len(self._open) >= MAX_OPEN_FRAMES:
                del self._open[next(iter(self._open))]  # the first that came: numbers may lie
            self._open[number] = _Frame()
        return self._open[number]

    def _convert(self, frame: _Frame) -> None:
        if self._drawn_in != len(self._writer.files):  # once in each file
            self._drawn_in = len(self._writer.files)
            self._add(frame, f"{_V2X}/road", shapes.road(self._road_map, frame.heard_ns))
        stamp_ns = frame.heard_ns
        places = {name: pose.pose for name, pose in frame.poses.items()}
        places |= {_sensor(name): scans[0].sensor_pose for name, scans in frame.scans.items()}
        placed = shapes.placed(places)
        if placed:
            self._add(frame, f"{_V2X}/transforms", shapes.transforms(placed, stamp_ns))
        for name in frame.poses:
            self._add(frame, f"{_V2X}/pose/{name}", shapes.agent_pose(placed[name], stamp_ns))
        if frame.detections is not None:
            boxes = shapes.detections(frame.detections, stamp_ns)
            self._add(frame, f"{_V2X}/detections", boxes)
        if frame.truth is not None:
            self._add(frame, f"{_WORLD}/truth", shapes.truth(frame.truth, self._types, stamp_ns))

    def _begin_clouds(self, frame: _Frame) -> None:
        if self._clouds or not self._budget.has_some(time.monotonic_ns()):
            self.clouds_left_out += bool(frame.scans)
        else:
            self._now = frame
            self._clouds = sorted(frame.scans, reverse=True)

    def _convert_cloud(self, agent: str) -> None:
        try:
            parts = [decode(scan.payload).points for scan in self._now.scans.pop(agent)]
        except CodecError:
            return  # the edge has counted it
        cloud = shapes.cloud(np.concatenate(parts), _sensor(agent), self._now.heard_ns)
        self._add(self._now, f"{_V2X}/cloud/{agent}", cloud)

    def _add(self, frame: _Frame, topic: str, shape: shapes.Shape) -> None:
        self._writer.write_shape(topic, shape, time.monotonic_ns(), frame.sim_time_ns)


def _drawn(item: Envelope) -> m.Message | None:
    """Returns what was said if it can be drawn, and read; the rest is left as it came."""
    try:
        return item.message if item.topic in _DRAWN else None
    except ProtocolError:
        return None  # it is on the tape, and who reads that counts it


def _sensor(agent: str) -> str:
    return f"{agent}/lidar"
