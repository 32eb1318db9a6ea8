"""Turns what was heard into Foxglove's messages, as far as there is time beside the taping."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from protocol import messages as m
from protocol.codec import decode
from protocol.courtesy import Budget
from protocol.errors import CodecError, ProtocolError
from protocol.inbox import Envelope
from tape import shapes
from tape.writer import TapeWriter

BOXES_PER_CORE = 0.01
"""Of the machine: so much of a core's time, for each core, may boxes and poses take."""
CLOUDS_PER_CORE = 0.01
"""And so much the clouds."""
MAX_OPEN_FRAMES = 8
MAX_FRAME_BYTES = 64 << 20
MAX_FRAME_MESSAGES = 1000
_DRAWN = frozenset({"pose", "scan", "truth", "detections"})
_Said = m.AgentPose | m.Scan | m.Truth | m.Detections
_V2X, _WORLD = "foxglove/v2x", "foxglove/world"  # topics of what agents say, and of the truth


@dataclass(slots=True)
class _Frame:
    """What was heard of a frame so far, most of it not read yet."""

    number: int
    heard: list[Envelope] = field(default_factory=list)
    size_bytes: int = 0

    def add(self, item: Envelope) -> bool:
        """Adds a message; returns whether there was room for it."""
        size_bytes = self.size_bytes + len(item.data)
        if size_bytes > MAX_FRAME_BYTES or len(self.heard) >= MAX_FRAME_MESSAGES:
            return False
        self.size_bytes = size_bytes
        self.heard.append(item)
        return True


@dataclass(slots=True)
class _Picture:
    """What was said of a frame."""

    heard_ns: int = 0
    sim_time_ns: int | None = None
    poses: dict[str, m.AgentPose] = field(default_factory=dict)
    scans: defaultdict[str, list[m.Scan]] = field(default_factory=lambda: defaultdict(list))
    truth: m.Truth | None = None
    detections: m.Detections | None = None

    @classmethod
    def of(cls, frame: _Frame) -> _Picture:
        """Reads what was heard of a frame; what cannot be read is left as it came."""
        picture = cls(frame.heard[0].received_ns)
        for item in frame.heard:
            if (said := _said_of(frame.number, item)) is not None:
                picture._add(said)
        return picture

    def _add(self, said: _Said) -> None:
        self.sim_time_ns = said.sim_time_ns
        match said:
            case m.AgentPose():
                self.poses[said.agent] = said
            case m.Scan():
                self.scans[said.agent].append(said)
            case m.Truth():
                self.truth = said
            case m.Detections():
                self.detections = said


class Scene:
    """Converts the newest frame that is whole; older ones are left out.

    Boxes and poses are cheap and come first. Clouds cost about as much as the edge's own decoding.
    Both have a budget, and while the clouds of one frame are made others are left without.
    """

    def __init__(
        self, setup: m.Setup, writer: TapeWriter, box_budget: Budget, cloud_budget: Budget
    ) -> None:
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._road_map = setup.road_map
        self._writer = writer
        self._box_budget = box_budget
        self._cloud_budget = cloud_budget
        self._open: dict[int, _Frame] = {}
        self._seen = -1
        self._due: _Frame | None = None
        self._now = _Picture()
        self._clouds: list[str] = []
        self._drawn_in = 0
        self.frames_left_out = 0
        self.clouds_left_out = 0

    def take(self, item: Envelope, number: int) -> None:
        """Notes a message of a frame, which is due once the edge said what it sees in the next."""
        if item.topic not in _DRAWN:
            return
        ends = item.topic == "detections"
        if ends and _said_of(number, item) is None:
            return
        if self._frame(number).add(item) and ends:
            self._close(number)

    def step(self) -> bool:
        """Does a little, a few milliseconds at most: the boxes of a frame, or a cloud.

        Returns whether there was anything to do.
        """
        if self._due is not None:
            due, self._due = self._due, None
            self._draw_road(due.heard[0].received_ns)
            if self._box_budget.has_some(time.monotonic_ns()):
                _pay(self._box_budget, lambda: self._convert(due))
            else:
                self.frames_left_out += 1
            return True
        if self._clouds:
            agent = self._clouds.pop()
            _pay(self._cloud_budget, lambda: self._convert_cloud(agent))
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
            self._open[number] = _Frame(number)
        return self._open[number]

    def _convert(self, frame: _Frame) -> None:
        picture = _Picture.of(frame)
        self._draw(picture)
        self._begin_clouds(picture)

    def _draw_road(self, stamp_ns: int) -> None:
        if self._drawn_in != len(self._writer.files):  # once in each file
            self._drawn_in = len(self._writer.files)
            shape = shapes.road(self._road_map, stamp_ns)
            self._writer.write_shape(f"{_V2X}/road", shape, time.monotonic_ns(), None)

    def _draw(self, frame: _Picture) -> None:
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

    def _begin_clouds(self, frame: _Picture) -> None:
        if self._clouds or not self._cloud_budget.has_some(time.monotonic_ns()):
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

    def _add(self, frame: _Picture, topic: str, shape: shapes.Shape) -> None:
        self._writer.write_shape(topic, shape, time.monotonic_ns(), frame.sim_time_ns)


def _said_of(number: int, item: Envelope) -> _Said | None:
    """Returns what was said of a frame, None if it cannot be read or is of another frame."""
    try:
        said = item.message
    except ProtocolError:
        return None  # it is on the tape, and who reads that counts it
    return said if isinstance(said, _Said) and said.frame == number else None


def _pay(budget: Budget, work: Callable[[], None]) -> None:
    """Works, and takes away from a budget what it has cost."""
    start_ns = time.thread_time_ns()
    work()
    budget.spend(time.thread_time_ns() - start_ns)


def _sensor(agent: str) -> str:
    return f"{agent}/lidar"
