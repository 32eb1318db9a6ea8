"""Training samples from real scans: frames with labels in KITTI's layout.

Generated streets lack most of what stands beside real ones. Windows of real frames, a share of
all, teach what is no vehicle. Within the range all vehicles must be labelled, or marked DontCare
by a box in space, which is not judged; what lies beyond is cut off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learning.examples import ABOVE_M, BELOW_M, PlacedSample
from learning.kitti_object import DONT_CARE, KittiFrame, kitti_frames, points_in
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
NOT_JUDGED = ("Misc", "Person_sitting", DONT_CARE)
_OF_NO_CERTAINTY = 1  # point: an object that is there and need not be found


@dataclass(frozen=True, slots=True)
class RealFrames:
    """A folder of labelled scans, the range to which they are labelled, and their share (0, 1)."""

    folder: Path
    range_m: float
    share: float

    def check(self) -> None:
        """Raises ConfigError if a number is out of bounds."""
        if not 0 < self.share < 1:
            raise ConfigError(f"--real-share {self.share}: must be more than 0, less than 1")
        if not 0 < self.range_m <= 200:
            raise ConfigError(f"--real-range {self.range_m}: must be more than 0 m, at most 200")

    def as_dict(self) -> dict[str, object]:
        """Returns it as plain values, frames by name."""
        names = [frame.name for frame in kitti_frames(self.folder)]
        return {"frames": names, "range_m": self.range_m, "share": self.share}

    def samples(self) -> list[PlacedSample]:
        """Reads all frames.

        Raises:
            ConfigError: there are none, or one is not what it should be.
        """
        frames = kitti_frames(self.folder)
        if not frames:
            raise ConfigError(f"--real {self.folder}: holds no cloud")
        return [placed(frame, self.range_m) for frame in frames]


def placed(frame: KittiFrame, range_m: float) -> PlacedSample:
    """Places a frame on the open ground around its sensor, its objects standing upon it.

    Raises:
        ConfigError: the cloud cannot be read.
    """
    cloud = read_points(frame.cloud)
    roadway = Roadway.of(ground_around(cloud, frame.name, range_m), margin_m=0.0)
    near = cloud.points[np.hypot(*cloud.points[:, :2].T) <= range_m]
    part = roadway.place(near, SE3.identity(), below_m=BELOW_M, above_m=ABOVE_M)
    part = on_the_ground(Cloud([part], [], np.zeros((1, 3)))).near[0]
    objects = [one for one in frame.objects if np.isfinite(one.box).all()]
    counts = [
        _OF_NO_CERTAINTY if one.kind in NOT_JUDGED else points_in(near, one.box) for one in objects
    ]
    boxes = np.array([one.box for one in objects]).reshape(-1, 7)
    boxes[:, 2] = boxes[:, 5] / 2
    return PlacedSample(
        points=[part.points],
        height_m=[part.points[:, 2] - part.road_m],
        on_road=[np.ones(len(part.points), np.bool_)],
        boxes=boxes,
        classes=np.array([CLASSES[one.kind] for one in objects], np.uint8),
        points_on=np.array([counts], np.int64).reshape(1, -1),
    )
