"""KITTI's labels and calibration of a scan, between the LiDAR's frame and the camera's.

There is no camera: its frame is the sensor's with other axes (x right, y down, z ahead), and what
needs an image is marked unknown as KITTI marks it (-1, -10). A line holds KITTI's 15 fields, the
number of the scan's points on the vehicle where results have their score, and the vehicle's id.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.arrays import Floats
from protocol.geometry import SE3, wrap_angle
from protocol.messages import ObjectClass

CLASSES = {
    ObjectClass.CAR: "Car",
    ObjectClass.TRUCK: "Truck",
    ObjectClass.TWO_WHEELER: "Cyclist",
    ObjectClass.PEDESTRIAN: "Pedestrian",
}
_BY_NAME = {name: found for found, name in CLASSES.items()}
FIELDS = 17
_SEEN, _UNKNOWN = 0, 3  # KITTI's occlusion

CALIB = (
    "".join(f"P{camera}: 1 0 0 0 0 1 0 0 0 0 1 0\n" for camera in range(4))
    + "R0_rect: 1 0 0 0 1 0 0 0 1\n"
    + "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    + "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n"
)


def line_of(
    box: Sequence[float] | Floats, object_class: ObjectClass, *, is_seen: bool = True
) -> str:
    """Returns KITTI's 15 fields of a box (7,) in the sensor frame."""
    x, y, z, length, width, height, yaw = box
    around = float(wrap_angle(-yaw - np.pi / 2))
    size = f"{height:.3f} {width:.3f} {length:.3f}"
    place = f"{-y:.3f} {height / 2 - z:.3f} {x:.3f}"
    unseen = f"{CLASSES[object_class]} -1 {_SEEN if is_seen else _UNKNOWN} -10 -1 -1 -1 -1"
    return f"{unseen} {size} {place} {around:.4f}"


@dataclass(frozen=True, slots=True)
class Label:
    """An object: box (7,) of centre, length, width, height and yaw, in the sensor frame."""

    vehicle: str
    box: tuple[float, ...]
    points: int
    object_class: ObjectClass = ObjectClass.CAR

    @property
    def line(self) -> str:
        """The label as a line of KITTI's."""
        line = line_of(self.box, self.object_class, is_seen=bool(self.points))
        return f"{line} {self.points} {self.vehicle}"

    @classmethod
    def of(cls, line: str) -> Label:
        """Reads a line.

        Raises:
            ValueError: it is no label of a vehicle.
        """
        words = line.split()
        if len(words) != FIELDS or words[0] not in _BY_NAME:
            known = ", ".join(_BY_NAME)
            raise ValueError(f"needs {FIELDS} fields, the first one of {known}: {line!r:.80}")
        height, width, length, right, down, ahead, around = (float(w) for w in words[8:15])
        yaw = float(wrap_angle(-around - np.pi / 2))
        box = (ahead, -right, height / 2 - down, length, width, height, yaw)
        if not np.isfinite(box).all() or min(length, width, height) <= 0:
            raise ValueError(f"a size or position is not a finite, positive number: {line!r:.80}")
        return cls(words[16], box, int(words[15]), _BY_NAME[words[0]])


def into_sensor(boxes: Floats, map_SE3_sensor: SE3) -> Floats:
    """Returns boxes (N, 7) of the map frame in the sensor frame, upright there as well."""
    result = boxes.copy()
    result[:, :3] = map_SE3_sensor.inverse().apply(boxes[:, :3])
    heading = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])])
    x, y = (heading @ map_SE3_sensor.rotation[:2, :2]).T
    result[:, 6] = np.arctan2(y, x)
    return result


def into_map(boxes: Floats, map_SE3_sensor: SE3) -> Floats:
    """Undoes `into_sensor`, headings included, for sensors that are not upside down."""
    result = boxes.copy()
    result[:, :3] = map_SE3_sensor.apply(boxes[:, :3])
    heading = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])])
    x, y = (heading @ np.linalg.inv(map_SE3_sensor.rotation[:2, :2])).T
    result[:, 6] = np.arctan2(y, x)
    return result
