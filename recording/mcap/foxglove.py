"""Converts recorded messages into Foxglove's, during a run or afterwards."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from protocol import messages as m
from protocol.codec import decode
from protocol.errors import CodecError, CpnetError
from protocol.inbox import Envelope
from protocol.observer import BufferedFrame, FrameBuffer, RateCap
from protocol.topics import TOPICS
from protocol.wire import peek_frame_time
from recording.mcap import foxglove_messages
from recording.mcap.format import PREVIOUS_FILE
from recording.mcap.reader import McapReader
from recording.mcap.writer import McapWriter

BOXES_PER_S, CLOUDS_PER_S = 2.0, 0.5
"""Frames per second that are converted during a run: with boxes and poses, and with clouds."""
WAITING_FRAMES = 4
"""The recorder polls less often than frames end: whole frames that wait to be converted."""
LAST_TOPIC = "detections"
CONVERTED_TOPICS = frozenset({"pose", "scan", "truth", LAST_TOPIC})
_V2X, _WORLD = "foxglove/v2x", "foxglove/world"  # topics of what agents say, and of the truth


@dataclass(slots=True)
class _FrameMessages:
    """The messages of a frame."""

    heard_ns: int = 0
    sim_time_ns: int | None = None
    poses: dict[str, m.AgentPose] = field(default_factory=dict)
    scans: defaultdict[str, list[m.Scan]] = field(default_factory=lambda: defaultdict(list))
    truth: m.Truth | None = None
    detections: m.Detections | None = None

    @classmethod
    def of(cls, frame: BufferedFrame) -> _FrameMessages:
        """Reads what was heard of a frame."""
        picture = cls(frame.received[0].received_ns)
        for message in frame.messages():
            picture._add(message)
        return picture

    def _add(self, message: m.Message) -> None:
        match message:
            case m.AgentPose():
                self.poses[message.agent] = message
            case m.Scan():
                self.scans[message.agent].append(message)
            case m.Truth():
                self.truth = message
            case m.Detections():
                self.detections = message
            case _:
                return
        self.sim_time_ns = message.sim_time_ns


class FoxgloveConverter:
    """Converts the newest frames that are whole; older ones are left out.

    Boxes and poses are cheap; clouds cost about as much as the edge's own decoding. Both have a
    cap on frames per second: frames beyond it are left out, or have no clouds.
    """

    def __init__(
        self,
        setup: m.Setup,
        writer: McapWriter,
        boxes_per_s: float = math.inf,
        clouds_per_s: float = math.inf,
    ) -> None:
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._road_map = setup.road_map
        self._writer = writer
        self._box_cap = RateCap(boxes_per_s)
        self._cloud_cap = RateCap(clouds_per_s)
        self._frames = FrameBuffer(LAST_TOPIC, WAITING_FRAMES)
        self._now = _FrameMessages()
        self._clouds: list[str] = []
        self._drawn_in = 0
        self._not_afforded = 0
        self.frames_drawn = 0
        self.clouds_left_out = 0

    @property
    def frames_left_out(self) -> int:
        """How many frames were whole and are not drawn."""
        return self._frames.left_out + self._not_afforded

    def take(self, item: Envelope, number: int) -> None:
        """Notes a message of a frame, which is due once the edge said what it sees in the next."""
        if item.topic in CONVERTED_TOPICS:
            self._frames.take(item, number)

    def finish(self) -> None:
        """Calls the last frame whole: no other will follow it."""
        self._frames.finish()

    def step(self) -> bool:
        """Does a little, a few milliseconds at most: the boxes of a frame, or a cloud.

        Returns whether there was anything to do.
        """
        if self._clouds:
            agent = self._clouds.pop()
            self._convert_cloud(agent)
        elif (due := self._frames.next()) is not None:
            self._draw_road(due.received[0].received_ns)
            if self._box_cap.take(time.monotonic_ns()):
                self._convert(due)
            else:
                self._not_afforded += 1
        else:
            return False
        return True

    def _convert(self, frame: BufferedFrame) -> None:
        self.frames_drawn += 1
        picture = _FrameMessages.of(frame)
        self._draw(picture)
        self._begin_clouds(picture)

    def _draw_road(self, stamp_ns: int) -> None:
        if self._drawn_in != len(self._writer.files):  # once in each file
            self._drawn_in = len(self._writer.files)
            shape = foxglove_messages.road(self._road_map, stamp_ns)
            self._writer.write_shape(f"{_V2X}/road", shape, stamp_ns, None)

    def _draw(self, frame: _FrameMessages) -> None:
        stamp_ns = frame.heard_ns
        places = {name: pose.pose for name, pose in frame.poses.items()}
        places |= {_sensor(name): scans[0].sensor_pose for name, scans in frame.scans.items()}
        placed = foxglove_messages.placed(places)
        if placed:
            self._add(frame, f"{_V2X}/transforms", foxglove_messages.transforms(placed, stamp_ns))
        for name in frame.poses:
            self._add(
                frame, f"{_V2X}/pose/{name}", foxglove_messages.agent_pose(placed[name], stamp_ns)
            )
        if frame.detections is not None:
            boxes = foxglove_messages.detections(frame.detections, stamp_ns)
            self._add(frame, f"{_V2X}/detections", boxes)
        if frame.truth is not None:
            self._add(
                frame,
                f"{_WORLD}/truth",
                foxglove_messages.truth(frame.truth, self._types, stamp_ns),
            )

    def _begin_clouds(self, frame: _FrameMessages) -> None:
        if self._cloud_cap.take(time.monotonic_ns()):
            self._now = frame
            self._clouds = sorted(frame.scans, reverse=True)
        else:
            self.clouds_left_out += bool(frame.scans)

    def _convert_cloud(self, agent: str) -> None:
        try:
            parts = [decode(scan.payload).points for scan in self._now.scans.pop(agent)]
        except CodecError:
            return  # the edge has counted it
        cloud = foxglove_messages.cloud(np.concatenate(parts), _sensor(agent), self._now.heard_ns)
        self._add(self._now, f"{_V2X}/cloud/{agent}", cloud)

    def _add(self, frame: _FrameMessages, topic: str, shape: foxglove_messages.Shape) -> None:
        self._writer.write_shape(topic, shape, frame.heard_ns, frame.sim_time_ns)


def _sensor(agent: str) -> str:
    return f"{agent}/lidar"


@dataclass(frozen=True, slots=True)
class FoxgloveFiles:
    """What came of it: the new files, and how many frames are in them."""

    files: list[Path]
    size_bytes: int
    frames: int


def export_foxglove(
    recording: McapReader,
    next_path: Callable[[], Path],
    cloud_every: int,
    tell: Callable[[int], None],
) -> FoxgloveFiles:
    """Writes boxes and poses of all frames of a recording, and the clouds of every n-th.

    Args:
        recording: what of it cannot be read is left out, and counted there.
        next_path: says where a new file is to be.
        cloud_every: n; frames are counted as the run did.
        tell: is called with how many frames are done.

    Raises:
        ConfigError: the recording cannot be read, or there can be no such file.
        CpnetError: the disk is full, or fails; then nothing is left.
    """
    facts = {name: fact for name, fact in recording.facts.items() if name != PREVIOUS_FILE}
    facts["made_of"] = ", ".join(file.name for file in recording.files)
    writer = McapWriter(next_path, recording.setup, facts)
    scene = FoxgloveConverter(recording.setup, writer)
    try:
        for item in recording.messages(CONVERTED_TOPICS):
            number = peek_frame_time(item.data, TOPICS[item.topic].message).frame
            if number is not None and (item.topic != "scan" or number % cloud_every == 0):
                scene.take(item, number)
                _draw(scene, tell)
            writer.settle(item.received_ns)
        scene.finish()
        _draw(scene, tell)
        writer.close({"frames_left_out": str(scene.frames_left_out)})
    except BaseException:  # an interruption as well: half of it would look whole
        with suppress(CpnetError):
            writer.close({})
        for file in writer.files:
            file.unlink(missing_ok=True)
        raise
    return FoxgloveFiles(writer.files, writer.size_bytes, scene.frames_drawn)


def _draw(scene: FoxgloveConverter, tell: Callable[[int], None]) -> None:
    drawn = False
    while scene.step():
        drawn = True
    if drawn:
        tell(scene.frames_drawn)
