"""Recordings converted for Foxglove: the same positions as in the messages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgpack
import numpy as np
import pytest
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_rig import writer_in

from protocol import messages as m
from protocol import wire
from protocol.codec import decode, encode_cloud
from protocol.geometry import SE3, euler_rotation
from protocol.inbox import Envelope
from protocol.observer import MAX_OPEN_FRAMES
from protocol.scans import PointCloud
from protocol.topics import TOPICS
from protocol.wire import encode
from recording.mcap import foxglove_messages, writer
from recording.mcap.format import next_file
from recording.mcap.foxglove import FoxgloveFiles, export_foxglove
from recording.mcap.reader import McapReader
from tests.messages import tracked

pytest.importorskip("mcap", reason="needs the extra `mcap`")


FRAMES = 6
SENSOR_POSE = np.array([10.0, -4.0, 2.4, 0.01, -0.02, 2.5])
BODY_POSE = np.array([10.0, -4.0, 0.0, 0.0, 0.0, 2.5])
BOXES = np.array([[1, 2, 0.75, 4.5, 1.8, 1.5, 0.3], [9, 8, 1, 5, 2, 2, -3]], np.float32)


def scan(frame: int, agent: str = "a", chunk: int = 0, chunks: int = 1) -> m.Scan:
    points = np.random.default_rng([frame, chunk]).uniform(-20, 20, (50, 3)).astype(np.float32)
    payload = encode_cloud(PointCloud(points, np.zeros(50, np.float32)), 0.02)
    return m.Scan(
        frame=frame,
        sim_time_ns=frame * 10**8,
        agent=agent,
        chunk=chunk,
        chunks=chunks,
        points=50,
        sensor_pose=SENSOR_POSE,
        sense_start_ns=1,
        sense_end_ns=2,
        encode_end_ns=3,
        payload=np.frombuffer(payload, np.uint8),
    )


def messages_of(frame: int) -> dict[str, m.Message]:
    """Returns the messages of a frame, by topic."""
    time_ns = frame * 10**8
    pose = m.AgentPose(
        frame=frame,
        sim_time_ns=time_ns,
        agent="a",
        equipment=m.Equipment.CAV,
        pose=BODY_POSE,
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0,
    )
    truth = m.Truth(
        frame=frame,
        sim_time_ns=time_ns,
        ids=["x", "y"],
        types=["car", "unheard of"],
        lanes=["in_0", "in_0"],
        poses=np.stack([BODY_POSE, BODY_POSE]),
        speeds_mps=np.zeros(2, np.float32),
        lane_positions_m=np.zeros(2, np.float32),
        equipment=np.zeros(2, np.uint8),
    )
    detections = m.Detections(
        frame=frame,
        sim_time_ns=time_ns,
        agents=["a"],
        boxes=BOXES,
        scores=np.ones(2, np.float32),
        classes=np.zeros(2, np.uint8),
        lanes=["in_0", ""],
        distances_m=np.ones(2, np.float32),
        sources=["lidar", "b"],
        **tracked(2),
    )
    return {"truth": truth, "pose": pose, "scan": scan(frame), "detections": detections}


def received(topic: str, message: m.Message, received_ns: int) -> Envelope:
    data = encode(message)
    parts = {part[1:-1]: "a" for part in TOPICS[topic].template.split("/") if "{" in part}
    return Envelope(topic, parts, None, received_ns, data)  # not read yet


class Recording:
    """A recording that is being written, and is then converted."""

    def __init__(self, folder: Path) -> None:
        self.writer = writer_in(folder)
        self.folder = folder / "new"

    def take(self, topic: str, message: m.Message, received_ns: int) -> None:
        self.writer.write(received(topic, message, received_ns))

    def record_frames(self, *frames: int) -> None:
        for frame in frames:
            for n, (topic, message) in enumerate(messages_of(frame).items()):
                self.take(topic, message, 10**9 * (frame + 1) + n)

    def convert(
        self, cloud_every: int = 1, tell: Callable[[int], None] = lambda _: None
    ) -> FoxgloveFiles:
        self.writer.close({})
        self.folder.mkdir()
        recording = McapReader(self.writer.files[0])
        return export_foxglove(recording, lambda: next_file(self.folder), cloud_every, tell)

    def read(self, cloud_every: int = 1) -> dict[str, list]:
        """Returns what an independent reader finds in the converted files, by topic."""
        found: dict[str, list] = {}
        for path in self.convert(cloud_every).files:
            for topic, messages in decoded(path).items():
                found.setdefault(topic, []).extend(messages)
        return found


def decoded(path: Path) -> dict[str, list]:
    """Returns what an independent reader finds in a file, by topic."""
    result: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            result.setdefault(channel.topic, []).append(message)
    return result


def points_of(cloud) -> np.ndarray:
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8)]
    return np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)


def rotation_of(q) -> np.ndarray:
    """Returns the matrix of a unit quaternion."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def place_of(pose) -> tuple[float, float, float]:
    return pose.position.x, pose.position.y, pose.position.z


def test_a_cloud_lies_on_the_map_where_its_agent_believes_it(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(3)
    found = recording.read()
    (cloud,) = found["foxglove/v2x/cloud/a"]
    (tree,) = found["foxglove/v2x/transforms"]
    (step,) = [one for one in tree.transforms if one.child_frame_id == cloud.frame_id]
    assert step.parent_frame_id == "map"
    assert step.timestamp.ToNanoseconds() == cloud.timestamp.ToNanoseconds() == 4 * 10**9
    moved = points_of(cloud) @ rotation_of(step.rotation).T
    moved += (step.translation.x, step.translation.y, step.translation.z)
    points = decode(scan(3).payload).points
    assert moved == pytest.approx(SE3.from_pose(SENSOR_POSE).apply(points), abs=1e-4)


def test_boxes_and_poses_are_those_that_were_said(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(0)
    found = recording.read()
    (update,) = found["foxglove/v2x/detections"]
    (entity,) = update.entities
    sizes = [(cube.size.x, cube.size.y, cube.size.z) for cube in entity.cubes]
    assert sizes == pytest.approx(BOXES[:, 3:6])
    assert [place_of(cube.pose) for cube in entity.cubes] == pytest.approx(BOXES[:, :3])
    assert [text.text for text in entity.texts] == ["in_0"]
    (pose,) = found["foxglove/v2x/pose/a"]
    assert place_of(pose.pose) == tuple(BODY_POSE[:3])
    turned = rotation_of(pose.pose.orientation)
    assert turned == pytest.approx(euler_rotation(*BODY_POSE[3:]), abs=1e-9)


def test_boxes_of_all_regions_are_together(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(0)
    elsewhere = messages_of(0)["detections"].model_copy(update={"boxes": BOXES + np.float32(1)})
    recording.take("detections", elsewhere, 10**9 + 9)
    (update,) = recording.read()["foxglove/v2x/detections"]
    assert sum(len(entity.cubes) for entity in update.entities) == 2 * len(BOXES)


def test_true_vehicles_stand_on_the_ground_and_are_apart(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(0)
    found = recording.read()
    assert sorted(topic for topic in found if "world" in topic) == ["foxglove/world/truth"]
    (cube,) = found["foxglove/world/truth"][0].entities[0].cubes  # the other's size is unknown
    assert place_of(cube.pose) == pytest.approx((10, -4, 0.75))
    assert (cube.size.x, cube.size.y, cube.size.z) == (4.5, 1.8, 1.5)


def test_a_large_cloud_is_thinned():
    points = np.random.default_rng(1).random((100_000, 3), np.float32)
    cloud = foxglove_messages.cloud(points, "a/lidar", 1)
    assert (points_of(cloud) == points[::4]).all()


def test_chunks_of_a_scan_are_one_cloud(tmp_path):
    recording = Recording(tmp_path)
    for chunk in range(3):
        recording.take("scan", scan(0, "b", chunk, 3), 10**9)
    recording.record_frames(0)
    found = recording.read()
    assert len(points_of(found["foxglove/v2x/cloud/b"][0])) == 150


def test_times_of_all_channels_are_on_one_axis(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(4)
    (cloud,) = recording.read()["foxglove/v2x/cloud/a"]
    assert cloud.timestamp.ToNanoseconds() == 5 * 10**9  # when the first of its frame was received


def test_the_road_is_drawn_once_in_each_file(tmp_path, monkeypatch):
    recording = Recording(tmp_path)
    recording.record_frames(*range(3))
    monkeypatch.setattr(writer, "MAX_CHANNELS", 1)
    made = recording.convert()
    roads = [road for path in made.files for road in decoded(path).get("foxglove/v2x/road", [])]
    assert len(roads) == 3
    assert [(p.x, p.y) for p in roads[0].entities[0].lines[0].points] == [(-50, 0), (0, 0)]


def test_clouds_are_those_of_each_nth_frame(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(*range(FRAMES))
    found = recording.read(cloud_every=4)
    assert len(found["foxglove/v2x/detections"]) == FRAMES
    assert len(found["foxglove/v2x/cloud/a"]) == 2


def test_each_frame_is_converted_and_told(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(*range(FRAMES))
    progress: list[int] = []
    made = recording.convert(tell=progress.append)
    assert (made.frames, progress) == (FRAMES, [*range(1, FRAMES + 1)])
    assert made.size_bytes == made.files[0].stat().st_size


def test_absurd_frame_numbers_keep_no_frame_from_being_drawn(tmp_path):
    recording = Recording(tmp_path)
    for n in range(MAX_OPEN_FRAMES):
        recording.take("scan", scan(10**9 + n), 1)
    recording.record_frames(*range(4))
    assert len(recording.read()["foxglove/v2x/detections"]) == 4


def test_a_scan_that_does_not_decode_is_left_out(tmp_path):
    recording = Recording(tmp_path)
    spoilt = scan(0, "b").model_copy(update={"payload": np.arange(40, dtype=np.uint8)})
    recording.take("scan", spoilt, 1)
    recording.record_frames(0)
    found = recording.read()
    assert [topic for topic in found if "cloud" in topic] == ["foxglove/v2x/cloud/a"]


def spoilt(topic: str, message: m.Message, **fields: object) -> Envelope:
    """Returns a message of which only the frame time can be decoded."""
    item = received(topic, message, 1)
    good = item.data[wire.PREFIX.size :]
    header = msgpack.unpackb(good[: wire.PREFIX.unpack_from(item.data)[3]].rstrip(b"\xc0"))
    packed = msgpack.packb(header | fields)
    body = good[wire.PREFIX.unpack_from(item.data)[3] :]
    prefix = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, message.kind, len(packed), len(body))
    return Envelope(topic, item.parts, None, 1, prefix + packed + body)


def test_what_cannot_be_read_is_left_out_and_ends_no_frame(tmp_path):
    recording = Recording(tmp_path)
    messages = messages_of(0)
    recording.writer.write(spoilt("pose", messages["pose"], agent="b", length_m=-1))
    recording.writer.write(spoilt("detections", messages["detections"], sources=[]))
    recording.record_frames(0)
    found = recording.read()
    assert [topic for topic in found if "pose" in topic] == ["foxglove/v2x/pose/a"]
    assert len(found["foxglove/v2x/detections"]) == 1


def test_of_a_recording_that_was_cut_there_is_what_can_be_read(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "CHUNK_BYTES", 1000)
    recording = Recording(tmp_path)
    recording.record_frames(*range(FRAMES))
    recording.writer.close({})
    (path,) = recording.writer.files
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])
    made = export_foxglove(McapReader(path), lambda: next_file(tmp_path, "new"), 1, print)
    assert 0 < made.frames < FRAMES


def test_a_translation_is_no_part_of_the_recording_and_itself_translates_to_nothing(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(0)
    (made,) = recording.convert().files
    again = export_foxglove(McapReader(made), lambda: next_file(tmp_path, "newer"), 1, print)
    assert again.frames == 0


def test_of_a_translation_that_is_broken_off_nothing_is_left(tmp_path):
    recording = Recording(tmp_path)
    recording.record_frames(*range(FRAMES))

    def interrupt(frames: int) -> None:
        if frames == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recording.convert(tell=interrupt)
    assert not [*recording.folder.iterdir()]


@given(st.lists(st.floats(-7, 7), min_size=3, max_size=3))
def test_a_quaternion_turns_as_its_angles_do(angles):
    x, y, z, w = foxglove_messages.quaternions(np.array([angles]))[0]
    turned = rotation_of(Quaternion(x=x, y=y, z=z, w=w))
    assert turned == pytest.approx(euler_rotation(*angles), abs=1e-9)
