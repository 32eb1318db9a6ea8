"""Recorded messages in Foxglove's schemas: https://docs.foxglove.dev/docs/sdk/schemas.

All is in the frame `map`, except clouds, which are in the frame of their sensor. Timestamps are on
the axis of the recording, as its log times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
MAP = "map"
MAX_POINTS = 30_000  # enough to see by
_FLOAT32 = PackedElementField.FLOAT32
_XYZ = [PackedElementField(name=n, offset=4 * i, type=_FLOAT32) for i, n in enumerate("xyz")]
_SEEN, _REPORTED = Color(r=1.0, g=0.55, b=0.1, a=0.6), Color(r=0.2, g=0.7, b=1.0, a=0.6)
_COASTING = Color(r=1.0, g=0.55, b=0.1, a=0.25)
_TRUE = Color(r=0.2, g=0.9, b=0.3, a=0.35)
_LANE = Color(r=0.5, g=0.5, b=0.5, a=0.8)
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_TEXT_M = 0.8
_LANE_M = 0.15
_NO_TURN = Quaternion(w=1.0)
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


def agent_pose(pose: Floats, stamp_ns: int) -> PoseInFrame:
    """Returns the pose (6,) of an agent by its own estimate."""
    return PoseInFrame(timestamp=_stamp(stamp_ns), frame_id=MAP, pose=_pose(pose))


def transforms(poses: Mapping[str, Floats], stamp_ns: int) -> FrameTransforms:
    """Returns `map_SE3_child`, given as pose (6,), by the name of the child."""
    stamp = _stamp(stamp_ns)
    placed = {child: _pose(pose) for child, pose in poses.items()}
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=MAP,
                child_frame_id=child,
                translation=pose.position,
                rotation=pose.orientation,
            )
            for child, pose in placed.items()
        ]
    )


def detections(message: Detections, stamp_ns: int) -> SceneUpdate:
    """Returns a box for each detected vehicle, faint if its track coasts, with its lane."""
    entity = _entity("detections", stamp_ns)
    boxes = message.boxes.astype(np.float64).tolist()
    for (x, y, z, *size, yaw), lane, source, coasted_s in zip(
        boxes, message.lanes, message.sources, message.coasted_s, strict=True
    ):
        seen = _SEEN if coasted_s == 0 else _COASTING
        color = seen if source == "lidar" else _REPORTED
        entity.cubes.append(_cube((x, y, z, 0.0, 0.0, yaw), size, color))
        if lane:
            above = Pose(
                position=Vector3(x=x, y=y, z=z + size[2] / 2 + _TEXT_M), orientation=_NO_TURN
            )
            entity.texts.append(
                TextPrimitive(pose=above, billboard=True, font_size=_TEXT_M, color=_TEXT, text=lane)
            )
    return SceneUpdate(entities=[entity])


def truth(message: Truth, types: Mapping[str, VehicleType], stamp_ns: int) -> SceneUpdate:
    """Returns a box for each true vehicle; one of a type that the setup lacks is left out."""
    entity = _entity("truth", stamp_ns)
    for name, pose in zip(message.types, message.poses.tolist(), strict=True):
        if (kind := types.get(name)) is not None:
            pose[2] += kind.height_m / 2  # a pose is that of the footprint
            size = (kind.length_m, kind.width_m, kind.height_m)
            entity.cubes.append(_cube(pose, size, _TRUE))
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


def _cube(pose: Sequence[float], size_m: Sequence[float], color: Color) -> CubePrimitive:
    length, width, height = size_m
    return CubePrimitive(pose=_pose(pose), size=Vector3(x=length, y=width, z=height), color=color)


def _pose(pose: Sequence[float] | Floats) -> Pose:
    """Converts a pose, x, y, z in m and roll, pitch, yaw in rad, to Foxglove's message."""
    x, y, z = (float(value) for value in pose[:3])
    i, j, k, w = quaternions(np.array(pose[3:])[None])[0].tolist()
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))


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
