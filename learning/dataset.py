"""A dataset on disk: its files, their line formats, and the reader.

KITTI's layout, plus where each scan was taken and on which road:

```
dataset.json                         version, arguments
ImageSets/{train,val,test}.txt       indices of scans; all of a network's are in one of them
poses.jsonl                          a line a scan, in the order of indices
networks/NAME/net.xml, road_map.json, description.json
training/velodyne/NNNNNN.bin         x, y, z, intensity as float32, sensor frame
training/label_2/NNNNNN.txt          see `learning.kitti`
training/calib/NNNNNN.txt
```
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError

from learning.kitti import Label, into_map
from perception.arrays import Bytes, Floats, Floats32, Ints
from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.roadmap import RoadMap
from sensing.point_files import read_points


@dataclass(frozen=True, slots=True, eq=False)
class SensorScan:
    """One LiDAR's scan: points (N, 3) in the sensor frame.

    `map_SE3_sensor` is the agent's estimate, `own` the index of the vehicle that carries the sensor
    among the sample's boxes; None at the roadside.
    """

    agent: str
    points: Floats32
    map_SE3_sensor: SE3
    own: int | None


@dataclass(frozen=True, slots=True, eq=False)
class SceneSample:
    """All scans taken at one time at one junction, and all vehicles there.

    `boxes` (M, 7) and `classes` (M,) are as in `perception.detector.Vehicles`, in the map frame;
    `points_on` (S, M) counts the returns of each scan that came from each vehicle.
    """

    network: str
    frame: int
    scans: list[SensorScan]
    boxes: Floats
    classes: Bytes
    points_on: Ints


VERSION = 1
INFO = "dataset.json"
POSES = "poses.jsonl"
NETWORKS = "networks"
NET = "net.xml"
ROAD_MAP = "road_map.json"
DESCRIPTION = "description.json"
REACH_M = 130.0  # of labels, from the sensor

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
Kind = Literal["roadside", "vehicle"]
Pose = Annotated[list[float], Field(min_length=6, max_length=6)]


class Info(BaseModel):
    """The file `dataset.json`."""

    model_config = ConfigDict(frozen=True)
    version: int
    networks: int
    samples: int = Field(validation_alias=AliasChoices("samples", "moments"))  # its former name
    seed: int
    realism: str = "paper"
    split: str | None = None
    furniture_per_100m: float = 0.0


class SensorPoses(BaseModel):
    """`map_SE3_sensor` as `SE3.from_pose` takes it: x, y, z in m; roll, pitch, yaw in rad."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    believed: Pose
    true: Pose


class ScanRow(BaseModel):
    """A line of `poses.jsonl`. `own` is the id of the vehicle that carries the sensor."""

    model_config = ConfigDict(frozen=True)
    index: Annotated[int, Field(ge=0)]
    network: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    frame: Annotated[int, Field(ge=0)]
    agent: str
    kind: Kind
    map_SE3_sensor: SensorPoses
    own: str | None = None


def split_path(folder: Path, split: Split) -> Path:
    """Returns the file with the indices of a split."""
    return folder / "ImageSets" / f"{split}.txt"


def scan_paths(folder: Path, index: int) -> tuple[Path, Path, Path]:
    """Returns a scan's cloud, labels and calibration."""
    training = folder / "training"
    return (
        training / "velodyne" / f"{index:06d}.bin",
        training / "label_2" / f"{index:06d}.txt",
        training / "calib" / f"{index:06d}.txt",
    )


def splits(networks: int) -> list[Split]:
    """Returns the split of each network by its number: the first 70 % train, 15 % each follow.

    Of three networks or more each split has one; fewer are all for training.
    """
    held = max(1, round(0.15 * networks)) if networks >= 3 else 0
    sizes: dict[Split, int] = {"train": networks - 2 * held, "val": held, "test": held}
    return [split for split, size in sizes.items() for _ in range(size)]


Model = TypeVar("Model", bound=BaseModel)


class Dataset:
    """A dataset in a folder; clouds and labels are read on demand.

    Raises:
        ConfigError: here and from each method: a file is missing or not what it should be.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.info = info = _parsed(Info, _text(folder / INFO), str(folder / INFO))
        if info.version != VERSION:
            raise ConfigError(
                f"{folder / INFO}: version {info.version}, this program reads {VERSION}"
            )
        self._samples: dict[tuple[str, int], list[ScanRow]] = {}
        self._rows: dict[int, ScanRow] = {}
        path = folder / POSES
        for number, line in enumerate(_text(path).splitlines(), 1):
            row = _parsed(ScanRow, line, f"{path}:{number}")
            self._rows[row.index] = row
            self._samples.setdefault((row.network, row.frame), []).append(row)

    def networks(self, split: Split) -> list[str]:
        """Returns the names of a split's networks."""
        return list(dict.fromkeys(network for network, _ in self.samples(split)))

    def samples(self, split: Split) -> list[tuple[str, int]]:
        """Returns a split's samples, as (network, frame)."""
        if split not in SPLITS:
            raise ConfigError(f"split {split!r}: allowed are {', '.join(SPLITS)}")
        path = split_path(self._folder, split)
        found: dict[tuple[str, int], None] = {}
        for number, word in enumerate(_text(path).split(), 1):
            row = self._rows.get(int(word)) if word.isdecimal() else None
            if row is None:
                raise ConfigError(f"{path}:{number}: {word:.20} is no scan of {POSES}")
            found[row.network, row.frame] = None
        return list(found)

    def road_map(self, network: str) -> RoadMap:
        """Returns a network's lanes and signal."""
        path = self._folder / NETWORKS / network / ROAD_MAP
        return _parsed(RoadMap, _text(path), str(path))

    def load(self, network: str, frame: int) -> SceneSample:
        """Reads a sample; of its vehicles, those within range of a sensor, sorted by id."""
        rows = self._samples.get((network, frame))
        if rows is None:
            raise ConfigError(f"{self._folder / POSES}: no scan of {network}, frame {frame}")
        clouds = [read_points(scan_paths(self._folder, row.index)[0]).points for row in rows]
        return sample_of(rows, [self._labels(row) for row in rows], clouds)

    def _labels(self, row: ScanRow) -> list[Label]:
        _, path, _ = scan_paths(self._folder, row.index)
        labels = []
        for number, line in enumerate(_text(path).splitlines(), 1):
            try:
                labels.append(Label.of(line))
            except ValueError as error:
                raise ConfigError(f"{path}:{number}: {error}") from None
        return labels


def sample_of(
    rows: Sequence[ScanRow], labels: Sequence[list[Label]], clouds: Sequence[Floats32]
) -> SceneSample:
    """Puts a sample's scans together; their vehicles, sorted by id, are in the map frame."""
    boxes: dict[str, Floats] = {}
    classes: dict[str, int] = {}
    for row, of_scan in zip(rows, labels, strict=True):
        placed = np.array([label.box for label in of_scan]).reshape(-1, 7)
        placed = into_map(placed, SE3.from_pose(row.map_SE3_sensor.true))
        for label, box in zip(of_scan, placed, strict=True):
            boxes.setdefault(label.vehicle, box)
            classes[label.vehicle] = label.object_class
    order = {vehicle: index for index, vehicle in enumerate(sorted(boxes))}
    points_on = np.zeros((len(rows), len(order)), np.int64)
    for scan, of_scan in enumerate(labels):
        for label in of_scan:
            points_on[scan, order[label.vehicle]] = label.points
    return SceneSample(
        network=rows[0].network,
        frame=rows[0].frame,
        scans=[
            SensorScan(
                agent=row.agent,
                points=points,
                map_SE3_sensor=SE3.from_pose(row.map_SE3_sensor.believed),
                own=None if row.own is None else order.get(row.own),
            )
            for row, points in zip(rows, clouds, strict=True)
        ],
        boxes=np.array([boxes[vehicle] for vehicle in order]).reshape(-1, 7),
        classes=np.array([classes[vehicle] for vehicle in order], np.uint8),
        points_on=points_on,
    )


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is no text in UTF-8") from None


def _parsed(model: type[Model], text: str, where: str) -> Model:
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{where}: {key + ': ' if key else ''}{first['msg']}") from None
