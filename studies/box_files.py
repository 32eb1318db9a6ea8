"""Detected boxes of a run as files: KITTI's labels, or a table (Parquet).

`NAME.parquet` has a row per box, in the map frame. `NAME.txt` is one file in the format of KITTI's
tracking labels (frame, track -1, then the fields of a label and the score), and a name without an
ending a folder with a file of KITTI's object labels per frame. KITTI's boxes are those of
`learning.kitti`: in the frame of the sensor, or of the vehicle, turned to a camera's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from learning.kitti import into_sensor, line_of
from perception.arrays import Floats
from perception.detector import LIDAR
from protocol.errors import ConfigError
from protocol.extras import to_install
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from recording.run import Run
from recording.tables import DetectionRow

_ENDINGS = (".parquet", ".txt", "")


def check_boxes(path: Path) -> None:
    """Checks that boxes can be written to a path.

    Raises:
        ConfigError: its ending is unknown, its folder does not exist, or it is a folder with files.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise ConfigError(
            f"--boxes {path}: ends in {path.suffix}; allowed are .parquet, .txt (KITTI's tracking "
            "labels) and no ending (a folder with KITTI's labels, a file per frame)"
        )
    if not path.parent.is_dir():
        raise ConfigError(f"--boxes {path}: the folder {path.parent} does not exist")
    if path.is_dir() != (path.suffix == "") and path.exists():
        raise ConfigError(f"--boxes {path}: is there already, and is of another kind")
    if path.is_dir() and any(path.iterdir()):
        raise ConfigError(f"--boxes {path}: the folder is not empty")
    if path.suffix.lower() == ".parquet":
        _polars()


def count_boxes(run_dir: Path) -> int:
    """Returns how many boxes were detected in the points of a run; coasting ones are not."""
    return len(_rows_of(run_dir))


def _rows_of(run_dir: Path) -> list[DetectionRow]:
    with Run(run_dir) as run:
        rows = run.rows(DetectionRow)
        return [row for row in rows if row.source == LIDAR and row.coasted_s == 0]


def write_boxes(run_dir: Path, path: Path, sensor_poses: Floats) -> int:
    """Writes the LiDAR detections of a run; returns the number of boxes.

    Args:
        run_dir: of the run.
        path: see this module, and `check_boxes`.
        sensor_poses: `map_SE3_sensor` by frame as (N, 6).

    Raises:
        ConfigError: the file cannot be written.
    """
    rows = _rows_of(run_dir)
    try:
        if path.suffix.lower() == ".parquet":
            _write_table(rows, path)
        else:
            _write_labels(rows, path, sensor_poses)
    except OSError as error:
        raise ConfigError(f"--boxes {path}: {error.strerror}") from None
    return len(rows)


def _polars() -> ModuleType:
    try:
        return import_module("polars")
    except ImportError:
        raise ConfigError(
            f"--boxes with .parquet needs polars (extra `study`): {to_install('study')}"
        ) from None


def _write_table(rows: Sequence[DetectionRow], path: Path) -> None:
    left_out = {"region", "detection", "lane", "distance_m", "source", "object_class"}
    names = [name for name in DetectionRow._fields if name not in left_out]
    columns = {name: [getattr(row, name) for row in rows] for name in names}
    classes = [ObjectClass(row.object_class).name.lower() for row in rows]
    pl = _polars()
    numbers = pl.DataFrame(columns, schema=dict.fromkeys(names, pl.Float64))
    frame = pl.col("frame").cast(pl.Int64)
    numbers.with_columns(frame, pl.Series("object_class", classes, pl.String)).write_parquet(path)


def _write_labels(rows: Sequence[DetectionRow], path: Path, sensor_poses: Floats) -> None:
    lines: list[list[str]] = [[] for _ in sensor_poses]
    for row in rows:
        box = np.array([[*row[3:6], *row[6:10]]])
        local = into_sensor(box, SE3.from_pose(sensor_poses[row.frame]))[0]
        lines[row.frame].append(f"{line_of(local, ObjectClass(row.object_class))} {row.score:.4f}")
    if path.suffix:
        numbered = [f"{n} -1 {line}\n" for n, of_frame in enumerate(lines) for line in of_frame]
        path.write_text("".join(numbered), "utf-8")
        return
    path.mkdir(exist_ok=True)
    for number, of_frame in enumerate(lines):
        (path / f"{number:06d}.txt").write_text("".join(f"{one}\n" for one in of_frame), "utf-8")
