"""What other tools see of a recording: the same places as the messages say, when there is time."""

from __future__ import annotations

from pathlib import Path

import msgpack
import numpy as np
import pytest
from cassette import same, setup, writer_in
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

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
from recording.mcap.foxglove import WAITING_FRAMES, FoxgloveConverter
from recording.mcap.reader import McapReader

pytest.importorskip("mcap", reason="needs the extra `mcap`")


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
        lanes=["in_0", ""],
        distances_m=np.ones(2, np.float32),
        sources=["lidar", "b"],
    )
    return {"truth": truth, "pose": pose, "scan": scan(frame), "detections": detections}


def heard(topic: str, message: m.Message, received_ns: int) -> Envelope:
    data = encode(message)
    parts = {part[1:-1]: "a" for part in TOPICS[topic].template.split("/") if "{" in part}
    return Envelope(topic, parts, None, received_ns, data)  # not read yet


class Booth:
    """A writer with a scene that has all the time in the world, or none for boxes or clouds."""

    def __init__(self, folder: Path, boxes: float = 1e9, clouds: float = 1e9) -> None:
        self.path = folder / "run.mcap"
        self.writer = writer_in(folder)
        self.scene = FoxgloveConverter(setup(), self.writer, boxes, clouds)

    def take(
        self, topic: str, message: m.Message, received_ns: int, frame: int | None = None
    ) -> None:
        number = message.frame if frame is None else frame
        self.scene.take(heard(topic, message, received_ns), number)

    def hear(self, frame: int, steps: int = 8) -> None:
        """Hears a frame, and the end of the next, so that it is due."""
        for n, (topic, message) in enumerate(messages_of(frame).items()):
            self.take(topic, message, 10**9 * (frame + 1) + n)
        self.take("detections", messages_of(frame + 1)["detections"], 10**9)
        for _ in range(steps):
            self.scene.step()

    def read(self) -> dict[str, list]:
        """Ends the recording; returns what an independent reader finds, by topic."""
        self.writer.close({})
        return decoded(self.path)


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
    booth = Booth(tmp_path)
    booth.hear(3)
    found = booth.read()
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
    booth = Booth(tmp_path)
    booth.hear(0)
    found = booth.read()
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


def test_true_vehicles_stand_on_the_ground_and_are_apart(tmp_path):
    booth = Booth(tmp_path)
    booth.hear(0)
    found = booth.read()
    assert sorted(topic for topic in found if "world" in topic) == ["foxglove/world/truth"]
    (cube,) = found["foxglove/world/truth"][0].entities[0].cubes  # nobody knows the other's size
    assert place_of(cube.pose) == pytest.approx((10, -4, 0.75))
    assert (cube.size.x, cube.size.y, cube.size.z) == (4.5, 1.8, 1.5)


def test_a_large_cloud_is_thinned():
    points = np.random.default_rng(1).random((100_000, 3), np.float32)
    cloud = foxglove_messages.cloud(points, "a/lidar", 1)
    assert (points_of(cloud) == points[::4]).all()


def test_chunks_of_a_scan_are_one_cloud(tmp_path):
    booth = Booth(tmp_path)
    for chunk in range(3):
        booth.take("scan", scan(0, "b", chunk, 3), 10**9)
    booth.hear(0)
    found = booth.read()
    assert len(points_of(found["foxglove/v2x/cloud/b"][0])) == 150


def test_times_of_all_channels_are_on_one_axis(tmp_path):
    booth = Booth(tmp_path)
    booth.hear(4)
    (cloud,) = booth.read()["foxglove/v2x/cloud/a"]
    assert cloud.timestamp.ToNanoseconds() == 5 * 10**9  # when the first of its frame was heard


def test_the_road_is_drawn_once_in_each_file(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "MAX_CHANNELS", 1)
    booth = Booth(tmp_path)
    for frame in range(3):
        booth.hear(frame)
        booth.writer.settle(0)
    found = booth.read()
    assert len(booth.writer.files) == 4
    (road,) = found["foxglove/v2x/road"]
    assert [(p.x, p.y) for p in road.entities[0].lines[0].points] == [(-50, 0), (0, 0)]


def test_beyond_the_rate_of_clouds_frames_have_boxes_alone(tmp_path):
    booth = Booth(tmp_path, clouds=1e-3)
    for frame in range(5):
        booth.hear(frame)
    assert (booth.scene.frames_left_out, booth.scene.clouds_left_out) == (0, 4)
    found = booth.read()
    assert len(found["foxglove/v2x/detections"]) == 5
    assert [len(clouds) for topic, clouds in found.items() if "cloud" in topic] == [1]


def test_beyond_the_rate_of_boxes_frames_are_left_out(tmp_path):
    booth = Booth(tmp_path, boxes=1e-3)
    for frame in range(5):
        booth.hear(frame)
    assert (booth.scene.frames_left_out, booth.scene.clouds_left_out) == (4, 0)
    assert len(booth.read()["foxglove/v2x/detections"]) == 1


def test_frames_that_nobody_had_time_for_are_counted(tmp_path):
    booth = Booth(tmp_path)
    for frame in range(WAITING_FRAMES + 3):
        booth.hear(frame, steps=0)
    while booth.scene.step():
        pass
    assert booth.scene.frames_left_out == 3
    assert len(booth.read()["foxglove/v2x/detections"]) == WAITING_FRAMES


def test_absurd_frame_numbers_keep_no_frame_from_being_drawn(tmp_path):
    booth = Booth(tmp_path)
    for n in range(MAX_OPEN_FRAMES):
        booth.take("scan", scan(10**9 + n), 1)
    for frame in range(4):
        booth.hear(frame)
    assert len(booth.read()["foxglove/v2x/detections"]) == 4


def test_a_scan_that_does_not_decode_is_left_out(tmp_path):
    booth = Booth(tmp_path)
    spoilt = scan(0, "b").model_copy(update={"payload": np.arange(40, dtype=np.uint8)})
    booth.take("scan", spoilt, 1)
    booth.hear(0)
    found = booth.read()
    assert [topic for topic in found if "cloud" in topic] == ["foxglove/v2x/cloud/a"]


def spoilt(topic: str, message: m.Message, **fields: object) -> Envelope:
    """Returns a message that nobody can read beyond its moment."""
    item = heard(topic, message, 1)
    good = item.data[wire.PREFIX.size :]
    header = msgpack.unpackb(good[: wire.PREFIX.unpack_from(item.data)[3]].rstrip(b"\xc0"))
    packed = msgpack.packb(header | fields)
    body = good[wire.PREFIX.unpack_from(item.data)[3] :]
    prefix = wire.PREFIX.pack(wire.MAGIC, wire.VERSION, message.kind, len(packed), len(body))
    return Envelope(topic, item.parts, None, 1, prefix + packed + body)


def test_what_cannot_be_read_is_left_out_and_ends_no_frame(tmp_path):
    booth = Booth(tmp_path)
    said = messages_of(0)
    booth.scene.take(spoilt("pose", said["pose"], agent="b", length_m=-1), 0)
    booth.scene.take(spoilt("detections", said["detections"], sources=[]), 0)
    assert not booth.scene.step()
    booth.hear(0)
    found = booth.read()
    assert [topic for topic in found if "pose" in topic] == ["foxglove/v2x/pose/a"]
    assert len(found["foxglove/v2x/detections"]) == 1


def test_a_message_is_drawn_in_the_frame_that_its_readers_take_it_for(tmp_path):
    booth = Booth(tmp_path)
    pose = messages_of(0)["pose"].model_copy(update={"agent": "b", "frame": 3})
    booth.take("pose", pose, 1, 0)  # it bears two numbers
    booth.hear(0)
    assert [topic for topic in booth.read() if "pose" in topic] == ["foxglove/v2x/pose/a"]


def test_what_is_for_other_tools_is_not_heard_again(tmp_path):
    booth = Booth(tmp_path)
    item = heard("pose", messages_of(0)["pose"], 5)
    booth.writer.write(item)
    booth.hear(0)
    booth.writer.close({})
    recording = McapReader(booth.path)
    assert same(recording.messages(), [item])
    assert recording.is_whole


@given(st.lists(st.floats(-7, 7), min_size=3, max_size=3))
def test_a_quaternion_turns_as_its_angles_do(angles):
    x, y, z, w = foxglove_messages.quaternions(np.array([angles]))[0]
    turned = rotation_of(Quaternion(x=x, y=y, z=z, w=w))
    assert turned == pytest.approx(euler_rotation(*angles), abs=1e-9)
