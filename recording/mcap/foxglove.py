"""Converts a recording into Foxglove's messages: boxes, poses, clouds, the road, the truth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocol import messages as m
from protocol.codec import decode
from protocol.errors import CodecError, CpnetError
from protocol.observer import BufferedFrame, FrameBuffer
from protocol.topics import TOPICS
from protocol.wire import peek_frame_time
from recording.mcap import foxglove_messages
from recording.mcap.format import PREVIOUS_FILE
from recording.mcap.reader import McapReader
from recording.mcap.writer import McapWriter
from recording.observation import joined_detections

LAST_TOPIC = "detections"
CONVERTED_TOPICS = frozenset({"pose", "scan", "truth", LAST_TOPIC})
_V2X, _WORLD = "foxglove/v2x", "foxglove/world"  # topics of data, and of the truth


@dataclass(frozen=True, slots=True)
class FoxgloveFiles:
    """Result of a conversion: the new files, and how many frames are in them."""

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
        recording: unreadable parts are left out, and counted there.
        next_path: returns the path of a new file.
        cloud_every: n; frames are counted as the run did.
        tell: is called with the number of frames done.

    Raises:
        ConfigError: the recording cannot be read, or there can be no such file.
        CpnetError: the disk is full, or fails; then no file is left.
    """
    facts = {name: fact for name, fact in recording.facts.items() if name != PREVIOUS_FILE}
    facts["made_of"] = ", ".join(file.name for file in recording.files)
    writer = McapWriter(next_path, recording.setup, facts)
    converter, frames = FoxgloveConverter(recording.setup, writer), FrameBuffer(LAST_TOPIC)

    def convert_whole() -> None:
        while (frame := frames.next()) is not None:
            converter.convert(frame)
            tell(converter.frames)

    try:
        for item in recording.messages(CONVERTED_TOPICS):
            number = peek_frame_time(item.data, TOPICS[item.topic].message).frame
            if number is not None and (item.topic != "scan" or number % cloud_every == 0):
                frames.take(item, number)
                convert_whole()
            writer.settle(item.received_ns)
        frames.finish()  # the last: no other follows it
        convert_whole()
        writer.close({"frames_left_out": str(frames.left_out)})
    except BaseException:  # an interruption as well: a partial file would look complete
        with suppress(CpnetError):
            writer.close({})
        for file in writer.files:
            file.unlink(missing_ok=True)
        raise
    return FoxgloveFiles(writer.files, writer.size_bytes, converter.frames)


class FoxgloveConverter:
    """Writes frames as Foxglove's messages, all with the time when the first of a frame came."""

    def __init__(self, setup: m.Setup, writer: McapWriter) -> None:
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._road_map = setup.road_map
        self._writer = writer
        self._files_with_road = 0
        self.frames = 0

    def convert(self, frame: BufferedFrame) -> None:
        """Writes the readable messages of a frame."""
        self.frames += 1
        stamp_ns = frame.received[0].received_ns
        if self._files_with_road != len(self._writer.files):
            self._files_with_road = len(self._writer.files)
            road = foxglove_messages.road(self._road_map, stamp_ns)
            self._writer.write_shape(f"{_V2X}/road", road, stamp_ns, None)
        for topic, (shape, sim_time_ns) in self._shapes(frame, stamp_ns).items():
            self._writer.write_shape(topic, shape, stamp_ns, sim_time_ns)

    def _shapes(
        self, frame: BufferedFrame, stamp_ns: int
    ) -> dict[str, tuple[foxglove_messages.Shape, int]]:
        """Returns message and simulated time by topic."""
        shapes: dict[str, tuple[foxglove_messages.Shape, int]] = {}
        poses: dict[str, foxglove_messages.Floats] = {}
        scans: defaultdict[str, list[m.Scan]] = defaultdict(list)
        found: m.Detections | None = None  # of all regions
        time_ns = 0
        for message in frame.messages():
            match message:
                case m.AgentPose():
                    poses[message.agent] = message.pose
                    pose = foxglove_messages.agent_pose(message.pose, stamp_ns)
                    shapes[f"{_V2X}/pose/{message.agent}"] = pose, message.sim_time_ns
                case m.Scan():
                    poses[_sensor(message.agent)] = message.sensor_pose
                    scans[message.agent].append(message)
                case m.Truth():
                    truth = foxglove_messages.truth(message, self._types, stamp_ns)
                    shapes[f"{_WORLD}/truth"] = truth, message.sim_time_ns
                case m.Detections():
                    found = message if found is None else joined_detections(found, message)
                case _:
                    continue
            time_ns = message.sim_time_ns
        if found is not None:
            boxes = foxglove_messages.detections(found, stamp_ns)
            shapes[f"{_V2X}/detections"] = boxes, found.sim_time_ns
        if poses:
            tree = foxglove_messages.transforms(poses, stamp_ns)
            shapes[f"{_V2X}/transforms"] = tree, time_ns
        for agent, chunks in scans.items():
            with suppress(CodecError):  # counted by the edge
                points = np.concatenate([decode(chunk.payload).points for chunk in chunks])
                cloud = foxglove_messages.cloud(points, _sensor(agent), stamp_ns)
                shapes[f"{_V2X}/cloud/{agent}"] = cloud, time_ns
        return shapes


def _sensor(agent: str) -> str:
    return f"{agent}/lidar"
