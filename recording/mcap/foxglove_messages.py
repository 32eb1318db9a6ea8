"""What was heard, in Foxglove's schemas: https://docs.foxglove.dev/docs/sdk/schemas.

All is in the frame `map`, except clouds, which are in the frame of their sensor. Timestamps are on
the axis of the recording, as its log times.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from protocol.messages import Detections, Truth, VehicleType
from protocol.roadmap import RoadMap

Floats = npt.NDArray[np.float64]
Shape = SceneUpdate | PointCloud | PoseInFrame | FrameTransforms
_Color = tuple[float, float, float, float]
MAP = "map"
MAX_POINTS = 30_000  # enough to see by; a whole cloud takes four times as long to compress
_FLOAT32 = PackedElementField.FLOAT32
_XYZ = [PackedElementField(name=n, offset=4 * i, type=_FLOAT32) for i, n in enumerate("xyz")]
_SEEN, _REPORTED, _TRUE = (1.0, 0.55, 0.1, 0.6), (0.2, 0.7, 1.0, 0.6), (0.2, 0.9, 0.3, 0.35)
_LANE = Color(r=0.5, g=0.5, b=0.5, a=0.8)
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_TEXT_M = 0.8
_LANE_M = 0.15
_NO_TURN = Quaternion(w=1.0)
_DOUBLE = struct.Struct("<d")
_HERE = Pose(position=Vector3(), orientation=_NO_TURN)


def cloud(points: npt.NDArray[np.float32], sensor: str, stamp_ns: int) -> PointCloud:
    """Returns points (N, 3) in the frame of their sensor, of more than 30 000 every n-th."""
    every = -(-len(points) // MAX_POINTS) or 1
    return PointCloud(
        timestamp=_stamp(stamp_ns),
        frame_id=sensor,
        pose=_HERE,
        point_stride=12,
        fields=_XYZ,
        data=np.ascontiguousarray(points[::every], np.float32).tobytes(),
    )


def placed(poses: Mapping[str, Floats]) -> dict[str, Pose]:
    """Returns poses (6,) in m and rad, by a name, as Foxglove has them."""
    rows = np.array([*poses.values()], np.float64).reshape(-1, 6)
    places, turns = rows[:, :3].tolist(), quaternions(rows[:, 3:]).tolist()
    return {
        name: Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
        for name, (x, y, z), (i, j, k, w) in zip(poses, places, turns, strict=True)
    }


def agent_pose(pose: Pose, stamp_ns: int) -> PoseInFrame:
    """Returns where an agent believes it is."""
    return PoseInFrame(timestamp=_stamp(stamp_ns), frame_id=MAP, pose=pose)


def transforms(poses: Mapping[str, Pose], stamp_ns: int) -> FrameTransforms:
    """Returns `map_SE3_child` by the name of the child."""
    stamp = _stamp(stamp_ns)
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=MAP,
                child_frame_id=child,
                translation=pose.position,
                rotation=pose.orientation,
            )
            for child, pose in poses.items()
        ]
    )


def detections(message: Detections, stamp_ns: int) -> SceneUpdate:
    """Returns a box for each vehicle that the edge knows of, with its lane above it."""
    boxes = message.boxes.astype(np.float64)
    turns = np.zeros((len(boxes), 3))
    turns[:, 2] = boxes[:, 6]
    colors = [_SEEN if source == "lidar" else _REPORTED for source in message.sources]
    entity = _entity("detections", stamp_ns)
    _add_cubes(entity, boxes[:, :3], turns, boxes[:, 3:6], colors)
    _add_labels(entity, boxes, message.lanes)
    return SceneUpdate(entities=[entity])


def truth(message: Truth, types: Mapping[str, VehicleType], stamp_ns: int) -> SceneUpdate:
    """Returns a box for each true vehicle; one of a type that the setup lacks is left out."""
    known = [n for n, name in enumerate(message.types) if name in types]
    kinds = [types[message.types[n]] for n in known]
    sizes = np.array([(k.length_m, k.width_m, k.height_m) for k in kinds]).reshape(-1, 3)
    poses = message.poses[known]
    centres = poses[:, :3].copy()
    centres[:, 2] += sizes[:, 2] / 2  # a pose is that of the footprint
    entity = _entity("truth", stamp_ns)
    _add_cubes(entity, centres, poses[:, 3:], sizes, [_TRUE] * len(known))
    return SceneUpdate(entities=[entity])


def road(road_map: RoadMap, stamp_ns: int) -> SceneUpdate:
    """Returns the centre lines of all lanes."""
    lines = [
        LinePrimitive(
            type=LinePrimitive.LINE_STRIP,
            pose=_HERE,
            thickness=_LANE_M,
            points=[Point3(x=x, y=y, z=z) for x, y, z in lane.centreline],
            color=_LANE,
        )
        for lane in road_map.lanes
    ]
    entity = _entity("road", stamp_ns)
    entity.lines.extend(lines)
    return SceneUpdate(entities=[entity])


def _entity(name: str, stamp_ns: int) -> SceneEntity:
    """Returns an entity, which takes the place of the last one of this name."""
    return SceneEntity(timestamp=_stamp(stamp_ns), frame_id=MAP, id=name)


def _add_cubes(
    entity: SceneEntity, centres: Floats, turns: Floats, sizes: Floats, colors: Sequence[_Color]
) -> None:
    """Adds cubes: centres, sizes (N, 3) in m; turns (N, 3) in rad: roll, pitch, yaw.

    All cubes are equally long in protobuf, and one that follows another is added to it: so they are
    written as the rows of an array, thirty times as fast as one by one.
    """
    rows = np.tile(_CUBE, (len(centres), 1))
    values = np.hstack([centres, quaternions(turns), sizes, np.reshape(colors, (-1, 4))])
    for column, at in enumerate(_CUBE_AT):
        rows[:, at : at + 8] = values[:, column : column + 1].astype("<f8").view(np.uint8)
    entity.MergeFromString(rows.tobytes())


def _places_of(marks: Sequence[float], row: bytes) -> list[int]:
    return [row.index(_DOUBLE.pack(mark)) for mark in marks]


def _cube_row() -> tuple[npt.NDArray[np.uint8], list[int]]:
    """Returns a cube in an entity as bytes, and where in them its numbers lie."""
    x, y, z, qx, qy, qz, qw, length, width, height, r, g, b, a = marks = [
        n + 0.5 for n in range(14)
    ]
    cube = CubePrimitive(
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)),
        size=Vector3(x=length, y=width, z=height),
        color=Color(r=r, g=g, b=b, a=a),
    )
    row = SceneEntity(cubes=[cube]).SerializeToString()
    return np.frombuffer(row, np.uint8), _places_of(marks, row)


_CUBE, _CUBE_AT = _cube_row()


def _add_labels(entity: SceneEntity, boxes: Floats, texts: Sequence[str]) -> None:
    """Adds a text above each box (N, 7) that has one, as `_add_cubes` does its cubes."""
    above = boxes[:, :3].copy()
    above[:, 2] += boxes[:, 5] / 2 + _TEXT_M
    rows: list[bytearray] = []
    for text, place in zip(texts, above.tolist(), strict=True):
        if text:
            row, marks_at = _label_row(text)
            label = bytearray(row)
            for at, value in zip(marks_at, place, strict=True):
                _DOUBLE.pack_into(label, at, value)
            rows.append(label)
    entity.MergeFromString(b"".join(rows))


@lru_cache(maxsize=1024)
def _label_row(text: str) -> tuple[bytes, list[int]]:
    """Returns a text in an entity as bytes, and where in them its place lies."""
    x, y, z = marks = [n + 0.5 for n in range(3)]
    pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=_NO_TURN)
    label = TextPrimitive(pose=pose, billboard=True, font_size=_TEXT_M, color=_TEXT, text=text)
    row = SceneEntity(texts=[label]).SerializeToString()
    return row, _places_of(marks, row)


def quaternions(turns: Floats) -> Floats:
    """Returns rotations (N, 4) as x, y, z, w of roll, pitch, yaw (N, 3).

    They turn as `protocol.geometry.euler_rotation` does.
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(turns.T / 2), np.sin(turns.T / 2)
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def _stamp(time_ns: int) -> Timestamp:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)
