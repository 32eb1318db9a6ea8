"""What was heard, in Foxglove's schemas: https://docs.foxglove.dev/docs/sdk/schemas.

All is in the frame `map`, except clouds, which are in the frame of their sensor. Timestamps are on
the axis of the tape, as its log times.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

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

from protocol.messages import AgentPose, Detections, Truth, VehicleType
from protocol.roadmap import RoadMap

Shape = SceneUpdate | PointCloud | PoseInFrame | FrameTransforms
MAP = "map"
_FLOAT32 = PackedElementField.FLOAT32
_XYZ = [PackedElementField(name=n, offset=4 * i, type=_FLOAT32) for i, n in enumerate("xyz")]
_SEEN = Color(r=1.0, g=0.55, b=0.1, a=0.6)
_REPORTED = Color(r=0.2, g=0.7, b=1.0, a=0.6)
_TRUE = Color(r=0.2, g=0.9, b=0.3, a=0.35)
_LANE = Color(r=0.5, g=0.5, b=0.5, a=0.8)
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_TEXT_M = 0.8
_LANE_M = 0.15
_NO_TURN = Quaternion(w=1.0)
_HERE = Pose(position=Vector3(), orientation=_NO_TURN)


def cloud(points: npt.NDArray[np.float32], sensor: str, stamp_ns: int) -> PointCloud:
    """Returns points (N, 3) in the frame of their sensor."""
    return PointCloud(
        timestamp=_stamp(stamp_ns),
        frame_id=sensor,
        pose=_HERE,
        point_stride=12,
        fields=_XYZ,
        data=np.ascontiguousarray(points, np.float32).tobytes(),
    )


def agent_pose(message: AgentPose, stamp_ns: int) -> PoseInFrame:
    """Returns where an agent believes it is."""
    return PoseInFrame(timestamp=_stamp(stamp_ns), frame_id=MAP, pose=_pose(message.pose))


def transforms(poses: Mapping[str, npt.NDArray[np.float64]], stamp_ns: int) -> FrameTransforms:
    """Returns `map_SE3_child` for poses (6,) by the name of the child."""
    stamp = _stamp(stamp_ns)
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=MAP,
                child_frame_id=child,
                translation=_vector(pose[:3]),
                rotation=_quaternion(*pose[3:]),
            )
            for child, pose in poses.items()
        ]
    )


def detections(message: Detections, stamp_ns: int) -> SceneUpdate:
    """Returns a box for each vehicle that the edge knows of, with its lane above it."""
    boxes = message.boxes.astype(np.float64)
    cubes = [
        CubePrimitive(
            pose=Pose(position=_vector(box[:3]), orientation=_quaternion(0.0, 0.0, box[6])),
            size=_vector(box[3:6]),
            color=_SEEN if source == "lidar" else _REPORTED,
        )
        for box, source in zip(boxes, message.sources, strict=True)
    ]
    texts = [_label(lane, box) for box, lane in zip(boxes, message.lanes, strict=True) if lane]
    return _scene("detections", stamp_ns, cubes=cubes, texts=texts)


def truth(message: Truth, types: Mapping[str, VehicleType], stamp_ns: int) -> SceneUpdate:
    """Returns a box for each true vehicle; one of a type that the setup lacks is left out."""
    found = zip(message.types, message.poses, strict=True)
    cubes = [_body(types[name], pose) for name, pose in found if name in types]
    return _scene("truth", stamp_ns, cubes=cubes)


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
    return _scene("road", stamp_ns, lines=lines)


def _scene(
    name: str,
    stamp_ns: int,
    *,
    cubes: Iterable[CubePrimitive] = (),
    texts: Iterable[TextPrimitive] = (),
    lines: Iterable[LinePrimitive] = (),
) -> SceneUpdate:
    """Returns one entity, which takes the place of the last one of this name."""
    entity = SceneEntity(
        timestamp=_stamp(stamp_ns), frame_id=MAP, id=name, cubes=cubes, texts=texts, lines=lines
    )
    return SceneUpdate(entities=[entity])


def _body(kind: VehicleType, pose: npt.NDArray[np.float64]) -> CubePrimitive:
    """Returns a vehicle as a box; its pose is that of the footprint's centre."""
    x, y, z, *turn = pose
    centre = Vector3(x=x, y=y, z=z + kind.height_m / 2)
    size = Vector3(x=kind.length_m, y=kind.width_m, z=kind.height_m)
    return CubePrimitive(
        pose=Pose(position=centre, orientation=_quaternion(*turn)), size=size, color=_TRUE
    )


def _label(text: str, box: npt.NDArray[np.float64]) -> TextPrimitive:
    above = Vector3(x=box[0], y=box[1], z=box[2] + box[5] / 2 + _TEXT_M)
    pose = Pose(position=above, orientation=_NO_TURN)
    return TextPrimitive(pose=pose, billboard=True, font_size=_TEXT_M, color=_TEXT, text=text)


def _pose(pose: npt.NDArray[np.float64]) -> Pose:
    return Pose(position=_vector(pose[:3]), orientation=_quaternion(*pose[3:]))


def _vector(values: npt.NDArray[np.float64]) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Returns the rotation of `protocol.geometry.euler_rotation`."""
    (cr, cp, cy), (sr, sp, sy) = (
        [f(angle / 2) for angle in (roll_rad, pitch_rad, yaw_rad)] for f in (math.cos, math.sin)
    )
    return Quaternion(
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )


def _stamp(time_ns: int) -> Timestamp:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)
