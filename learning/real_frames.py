"""Training samples from real scans: frames with labels in KITTI's layout.

Generated streets lack most of what stands beside real ones. Windows of real frames, a share of
all, teach what is no vehicle. Within the range all vehicles must be labelled, or marked DontCare
by a box in space of a car's size, on which cars are not judged; what lies beyond is cut off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learning.examples import ABOVE_M, BELOW_M, PlacedSample
from learning.kitti_object import DONT_CARE, KittiFrame, kitti_frames, points_in
from perception.arrays import Bools, Floats32
from perception.detector import Cloud
from perception.map_height import on_the_ground
from perception.roadway import Roadway
from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from recording.foreign_scans.importer import ground_around
from sensing.point_files import read_points

CLASSES = {
    "Car": ObjectClass.CAR,
    "Van": ObjectClass.CAR,
    "Truck": ObjectClass.TRUCK,
    "Tram": ObjectClass.TRUCK,
    "Misc": ObjectClass.CAR,
    "Cyclist": ObjectClass.TWO_WHEELER,
    "Pedestrian": ObjectClass.PEDESTRIAN,
    "Person_sitting": ObjectClass.PEDESTRIAN,
    DONT_CARE: ObjectClass.CAR,
}
LEAST_SHARE = 0.01
NOT_JUDGED = ("Misc", "Person_sitting", DONT_CARE)
_UNSURE_POINTS = 1  # below `SURE_POINTS`: the object's anchors are not judged


@dataclass(frozen=True, slots=True)
class RealFrames:
    """A folder of labelled scans, the range to which they are labelled, and their share (0, 1)."""

    folder: Path
    range_m: float
    share: float

    def check(self) -> None:
        """Raises ConfigError if a number is out of bounds."""
        if not LEAST_SHARE <= self.share <= 1 - LEAST_SHARE:
            raise ConfigError(
                f"--real-share {self.share}: must be {LEAST_SHARE} to {1 - LEAST_SHARE}"
            )
        if not 0 < self.range_m <= 200:
            raise ConfigError(f"--real-range {self.range_m}: must be more than 0 m, at most 200")

    def samples(self) -> dict[str, PlacedSample]:
        """Reads all frames, by name; they stay in memory.

        Raises:
            ConfigError: there are none, or one is not what it should be.
        """
        try:
            frames = kitti_frames(self.folder)
            return {frame.name: placed(frame, self.range_m) for frame in frames}
        except ConfigError as error:
            raise ConfigError(f"--real: {error}") from None


def placed(frame: KittiFrame, range_m: float) -> PlacedSample:
    """Places a frame on the open ground around its sensor, its objects standing upon it.

    With a camera's calibration, only what lies in the image is kept, and not in its regions
    DontCare: elsewhere nothing is labelled.

    Raises:
        ConfigError: the cloud cannot be read, or has no point there.
    """
    cloud = read_points(frame.cloud)
    roadway = Roadway.of(ground_around(cloud, frame.name, range_m), margin_m=0.0)
    near = cloud.points[np.hypot(*cloud.points[:, :2].T) <= range_m]
    near = near[_are_labelled(frame, near)]
    if not len(near):
        raise ConfigError(f"{frame.cloud}: no point within {range_m:g} m where there are labels")
    part = roadway.place(near, SE3.identity(), below_m=BELOW_M, above_m=ABOVE_M)
    part = on_the_ground(Cloud([part], [], np.zeros((1, 3)))).near[0]
    objects = [one for one in frame.objects if np.isfinite(one.box).all()]
    counts = [
        _UNSURE_POINTS if one.kind in NOT_JUDGED else points_in(near, one.box) for one in objects
    ]
    boxes = np.array([one.box for one in objects]).reshape(-1, 7)
    boxes[:, 2] = boxes[:, 5] / 2
    return PlacedSample(
        points=[part.points],
        height_m=[part.points[:, 2] - part.road_m],
        on_road=[np.ones(len(part.points), np.bool_)],
        boxes=boxes,
        classes=np.array([CLASSES[one.kind] for one in objects], np.uint8),
        points_on=np.array([counts], np.int64),
    )


def _are_labelled(frame: KittiFrame, points: Floats32) -> Bools:
    """Marks the points (N, 3) that lie where the frame has labels."""
    if frame.calibration.pixels_P_camera is None:
        return np.ones(len(points), np.bool_)
    pixels, inside = frame.calibration.pixels_of(points)
    for one in frame.objects:
        if one.kind == DONT_CARE and np.isfinite(one.image).all():
            left, top, right, bottom = one.image
            inside &= ~(
                (pixels >= (left, top)).all(axis=1) & (pixels <= (right, bottom)).all(axis=1)
            )
    return inside
