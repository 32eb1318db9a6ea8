"""Reader of KITTI's object benchmark layout: clouds, labels and calibration of frames.

```
velodyne/NAME.bin   or another cloud that `sensing.point_files` reads
label_2/NAME.txt    KITTI's 15 fields a line; more are left unread
calib/NAME.txt      P2, R0_rect, Tr_velo_to_cam; without the file there is no image, and labels are
                    in the LiDAR's frame turned to a camera's axes (x right, y down, z ahead)
```

The folder may be the one that holds these, or one with `training` in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.arrays import Bools, Floats, Floats32
from protocol.config import is_folder
from protocol.errors import ConfigError
from sensing.point_files import point_files

KINDS = (
    "Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare",
)  # fmt: skip
DONT_CARE = "DontCare"
_LABEL_FIELDS = 15
_NOWHERE_M = -999.0  # KITTI's coordinate of an object without position, and less
_NEAREST_M = 0.1  # before the camera


@dataclass(frozen=True, slots=True, eq=False)
class KittiObject:
    """A label: box (7,) in the LiDAR's frame, NaN where it has none.

    `image` (4,) is left, top, right, bottom in pixels; `truncated` and `occluded` are KITTI's, and
    negative where it is not given.
    """

    kind: str
    box: Floats
    image: Floats
    truncated: float
    occluded: int


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Camera from LiDAR (4, 4), and pixels from camera (3, 4); None where there is no image."""

    camera_T_lidar: Floats
    pixels_P_camera: Floats | None

    @classmethod
    def without_camera(cls) -> Calibration:
        """Returns that of labels in the LiDAR's frame, turned to a camera's axes."""
        turn = [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
        return cls(np.array(turn), None)

    def box(self, place: Floats, size: Floats, around: float) -> Floats:
        """Returns a box (7,) of KITTI's place (3,), height, width, length (3,) and rotation."""
        height, width, length = size
        lidar_T_camera = np.linalg.inv(self.camera_T_lidar)
        middle = lidar_T_camera @ [place[0], place[1] - height / 2, place[2], 1.0]
        ahead = lidar_T_camera[:3, :3] @ [np.cos(around), 0.0, -np.sin(around)]
        return np.array([*middle[:3], length, width, height, np.arctan2(ahead[1], ahead[0])])

    def image_of(self, boxes: Floats) -> tuple[Floats, Bools]:
        """Returns boxes (N, 7) in the image, left, top, right, bottom (N, 4), and which are in it.

        The image's middle is the camera's axis: its size is not in the files. Without an image all
        are, and their places are NaN.
        """
        if self.pixels_P_camera is None:
            return np.full((len(boxes), 4), np.nan), np.ones(len(boxes), np.bool_)
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
        corners = signs[None] * boxes[:, None, 3:6]
        cos, sin = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
        x = cos * corners[..., 0] - sin * corners[..., 1] + boxes[:, 0, None]
        y = sin * corners[..., 0] + cos * corners[..., 1] + boxes[:, 1, None]
        z = corners[..., 2] + boxes[:, 2, None]
        flat, depth_m = self._projected(np.stack([x, y, z], -1))
        middle, most = flat.mean(axis=1), self._image_size
        inside = (depth_m > _NEAREST_M).all(axis=1)
        inside &= ((middle >= 0) & (middle < most)).all(axis=1)
        low, high = flat.min(axis=1).clip(0, most), flat.max(axis=1).clip(0, most)
        return np.concatenate([low, high], axis=1), inside

    def pixels_of(self, points: Floats32) -> tuple[Floats, Bools]:
        """Returns points (N, 3) in the image (N, 2), and which are in it; there must be one."""
        pixels, depth_m = self._projected(points.astype(np.float64))
        inside = ((pixels >= 0) & (pixels < self._image_size)).all(axis=1)
        return pixels, np.asarray(inside & (depth_m > _NEAREST_M))

    def _projected(self, points: Floats) -> tuple[Floats, Floats]:
        """Returns points (..., 3) in pixels (..., 2), and how far before the camera they lie."""
        camera = points @ self.camera_T_lidar[:3, :3].T + self.camera_T_lidar[:3, 3]
        assert self.pixels_P_camera is not None
        image = camera @ self.pixels_P_camera[:, :3].T + self.pixels_P_camera[:, 3]
        depth_m = image[..., 2]
        return image[..., :2] / np.maximum(depth_m, _NEAREST_M)[..., None], depth_m

    @property
    def _image_size(self) -> Floats:
        """Width and height in pixels, if the image's middle is the camera's axis."""
        assert self.pixels_P_camera is not None
        return 2 * self.pixels_P_camera[:2, 2]


@dataclass(frozen=True, slots=True, eq=False)
class KittiFrame:
    """A frame's cloud, what is labelled in it, and the calibration of its labels."""

    name: str
    cloud: Path
    objects: Sequence[KittiObject]
    calibration: Calibration


def kitti_frames(folder: Path) -> list[KittiFrame]:
    """Reads the labels of all frames of a folder, by name.

    Raises:
        ConfigError: something is missing or is not what it should be; names file and line.
    """
    if not is_folder(folder):
        raise ConfigError(f"{folder} does not exist")
    if not (folder / "velodyne").is_dir() and (folder / "training" / "velodyne").is_dir():
        folder = folder / "training"
    for part in ("velodyne", "label_2"):
        if not (folder / part).is_dir():
            raise ConfigError(f"{folder}: lacks the folder {part}; needs velodyne, label_2, calib")
    frames: dict[str, KittiFrame] = {}
    for cloud in point_files([folder / "velodyne"]):
        name = cloud.name.split(".")[0]
        if name in frames:
            raise ConfigError(f"{cloud}: another cloud is called {name} up to the first dot")
        path = folder / "calib" / f"{name}.txt"
        calibration = _calibration(path) if path.is_file() else Calibration.without_camera()
        objects = _objects(folder / "label_2" / f"{name}.txt", calibration)
        frames[name] = KittiFrame(name, cloud, objects, calibration)
    return list(frames.values())


def _objects(path: Path, calibration: Calibration) -> list[KittiObject]:
    objects = []
    for number, line in enumerate(_lines(path), 1):
        words, where = line.split(), f"{path}:{number}"
        if not words:
            continue
        if len(words) < _LABEL_FIELDS or words[0] not in KINDS:
            raise ConfigError(
                f"{where}: needs {_LABEL_FIELDS} fields or more, the first one of "
                f"{', '.join(KINDS)}: {line!r:.80}"
            )
        numbers = _numbers(words[1:_LABEL_FIELDS], where)
        size, place = numbers[7:10], numbers[10:13]
        has_box = bool((size > 0).all() and (place > _NOWHERE_M).all())
        if not has_box and words[0] != DONT_CARE:
            raise ConfigError(f"{where}: a size must be above 0, and a place told: {line!r:.80}")
        box = calibration.box(place, size, float(numbers[13])) if has_box else np.full(7, np.nan)
        image = numbers[3:7] if numbers[5] > numbers[3] else np.full(4, np.nan)
        objects.append(KittiObject(words[0], box, image, float(numbers[0]), int(numbers[1])))
    return objects


def _calibration(path: Path) -> Calibration:
    found: dict[str, Floats] = {}
    for number, line in enumerate(_lines(path), 1):
        key, _, rest = line.partition(":")
        if key in ("P2", "R0_rect", "Tr_velo_to_cam"):
            found[key] = _numbers(rest.split(), f"{path}:{number}")
    for key, size in (("P2", 12), ("R0_rect", 9), ("Tr_velo_to_cam", 12)):
        if len(found.get(key, ())) != size:
            raise ConfigError(f"{path}: needs a line {key}: with {size} numbers")
    rectified, camera = np.eye(4), np.eye(4)
    rectified[:3, :3] = found["R0_rect"].reshape(3, 3)
    camera[:3] = found["Tr_velo_to_cam"].reshape(3, 4)
    whole = rectified @ camera
    if abs(float(np.linalg.det(whole)) - 1) > 0.01:
        raise ConfigError(f"{path}: R0_rect and Tr_velo_to_cam are no motion of a solid body")
    pixels = found["P2"].reshape(3, 4)
    return Calibration(whole, pixels if pixels[0, 2] > 0 and pixels[1, 2] > 0 else None)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text("utf-8").splitlines()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is no text in UTF-8") from None


def _numbers(words: Sequence[str], where: str) -> Floats:
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    if not np.isfinite(numbers).all():
        raise ConfigError(f"{where}: a number is not finite")
    return numbers


def points_in(points: Floats32, box: Floats) -> int:
    """Counts the points (N, 3) in a box (7,) of the same frame."""
    off = points - box[:3]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    along, across = cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]
    local = np.stack([along, across, off[:, 2]], -1)
    return int((np.abs(local) <= box[3:6] / 2).all(axis=1).sum())
