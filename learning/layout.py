"""The files of a dataset: KITTI's layout, plus where each scan was taken and on which road.

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

from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

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
    moments: int
    seed: int


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
