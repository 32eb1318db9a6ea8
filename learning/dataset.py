"""The reading side of a dataset; `learning.layout` has its files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from learning.kitti import Label, into_map
from learning.layout import (
    INFO,
    NETWORKS,
    POSES,
    ROAD_MAP,
    SPLITS,
    VERSION,
    Info,
    ScanRow,
    Split,
    scan_paths,
    split_path,
)
from learning.moments import Moment, Shot
from perception.arrays import Floats, Floats32
from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.roadmap import RoadMap
from sensing.point_files import read_points

Model = TypeVar("Model", bound=BaseModel)


class Dataset:
    """A dataset in a folder; clouds and labels are read when they are asked for.

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
        self._moments: dict[tuple[str, int], list[ScanRow]] = {}
        self._rows: dict[int, ScanRow] = {}
        path = folder / POSES
        for number, line in enumerate(_text(path).splitlines(), 1):
            row = _parsed(ScanRow, line, f"{path}:{number}")
            self._rows[row.index] = row
            self._moments.setdefault((row.network, row.frame), []).append(row)

    def networks(self, split: Split) -> list[str]:
        """Returns the names of a split's networks."""
        return list(dict.fromkeys(network for network, _ in self.moments(split)))

    def moments(self, split: Split) -> list[tuple[str, int]]:
        """Returns a split's moments, as (network, frame)."""
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

    def load(self, network: str, frame: int) -> Moment:
        """Reads a moment; of its vehicles, those within reach of a sensor, sorted by id."""
        rows = self._moments.get((network, frame))
        if rows is None:
            raise ConfigError(f"{self._folder / POSES}: no scan of {network}, frame {frame}")
        clouds = [read_points(scan_paths(self._folder, row.index)[0]).points for row in rows]
        return moment_of(rows, [self._labels(row) for row in rows], clouds)

    def _labels(self, row: ScanRow) -> list[Label]:
        _, path, _ = scan_paths(self._folder, row.index)
        labels = []
        for number, line in enumerate(_text(path).splitlines(), 1):
            try:
                labels.append(Label.of(line))
            except ValueError as error:
                raise ConfigError(f"{path}:{number}: {error}") from None
        return labels


def moment_of(
    rows: Sequence[ScanRow], labels: Sequence[list[Label]], clouds: Sequence[Floats32]
) -> Moment:
    """Puts a moment's scans together; their vehicles, sorted by id, stand in the map frame."""
    boxes: dict[str, Floats] = {}
    for row, of_scan in zip(rows, labels, strict=True):
        placed = np.array([label.box for label in of_scan]).reshape(-1, 7)
        placed = into_map(placed, SE3.from_pose(row.map_SE3_sensor.true))
        for label, box in zip(of_scan, placed, strict=True):
            boxes.setdefault(label.vehicle, box)
    order = {vehicle: index for index, vehicle in enumerate(sorted(boxes))}
    points_on = np.zeros((len(rows), len(order)), np.int64)
    for shot, of_scan in enumerate(labels):
        for label in of_scan:
            points_on[shot, order[label.vehicle]] = label.points
    return Moment(
        network=rows[0].network,
        frame=rows[0].frame,
        shots=[
            Shot(
                agent=row.agent,
                points=points,
                map_SE3_sensor=SE3.from_pose(row.map_SE3_sensor.believed),
                own=None if row.own is None else order.get(row.own),
            )
            for row, points in zip(rows, clouds, strict=True)
        ],
        boxes=np.array([boxes[vehicle] for vehicle in order]).reshape(-1, 7),
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
