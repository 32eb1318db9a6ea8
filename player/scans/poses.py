"""Where agents were: tables and the text files of KITTI and of EMP.

A pose is that of the sensor, or of the vehicle where extrinsics say how sensors are mounted on it.

- CSV: columns x_m, y_m, z_m and, if you like, roll_deg, pitch_deg, yaw_deg (0), time_s, agent. A
  line a frame, of each agent.
- Text: a line a frame with 6 numbers, x y z roll pitch yaw in m and rad (EMP, MobiCom 2021); with
  12, the rows of [R|t], map from sensor; or with 30, a line of KITTI's oxts, of which latitude,
  longitude, altitude, roll, pitch and yaw are used: the first pose is the origin, x east, y north.
- A folder: its .txt files in order, a line each, as KITTI's oxts/data; of several agents a folder
  each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.scans.folder import by_agent
from player.scans.numbers import lines_of, numbers_of
from player.scans.table import rows_of
from protocol.config import is_folder
from protocol.errors import ConfigError
from protocol.geometry import SE3, Floats

MOST = np.array([1e7, 1e7, 1e7, 1e3, 1e3, 1e3])  # m, rad: as messages take
_EARTH_M = 6_378_137.0
_EMP, _MATRIX, _OXTS = 6, 12, 30


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """An agent's poses (N, 6) in the map frame, and their times in s (N,), None if not told."""

    poses: Floats
    times_s: Floats | None = None


def read_poses(path: Path) -> dict[str, Track]:
    """Returns the tracks by agent; the name is empty where a file has one track and no name.

    Raises:
        ConfigError: a file cannot be read, or a line of it; names file and line.
    """
    if is_folder(path):
        files = sorted(file for file in path.rglob("*.txt") if file.is_file())
        if not files:
            raise ConfigError(f"{path} holds no .txt file with poses")
        named = by_agent(path, files)
        tracks = {name: _text_track(group) for name, group in named.items()}
        return {"": next(iter(tracks.values()))} if len(tracks) == 1 else tracks
    if path.suffix.lower() == ".csv":
        return _table_tracks(path)
    return {"": _text_track([path])}


def _table_tracks(path: Path) -> dict[str, Track]:
    poses: dict[str, list[Floats]] = {}
    times_s: dict[str, list[float]] = {}
    for row in rows_of(path, ("agent", "time_s")):
        agent = row.others.get("agent", "")
        poses.setdefault(agent, []).append(_checked(row.pose, row.where))
        if "time_s" in row.others:
            (time_s,) = numbers_of([row.others["time_s"]], row.where)
            before = times_s.setdefault(agent, [])
            if abs(time_s) > 1e10 or (before and time_s <= before[-1]):
                raise ConfigError(f"{row.where}: time_s must ascend, and be 1e10 at most")
            before.append(time_s)
    if not poses:
        raise ConfigError(f"{path}: line 2: no pose follows the column names")
    return {
        agent: Track(np.stack(rows), np.array(times_s[agent]) if agent in times_s else None)
        for agent, rows in poses.items()
    }


def _text_track(files: Sequence[Path]) -> Track:
    rows: list[list[float]] = []
    for file in files:
        for number, line in enumerate(lines_of(file), 1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            where = f"{file}: line {number}"
            found = numbers_of(line.split(), where)
            known = (_EMP, _MATRIX, _OXTS)
            if len(found) not in known or (rows and len(found) != len(rows[0])):
                wanted = str(len(rows[0])) if rows else "6, 12 or 30"
                raise ConfigError(f"{where}: has {len(found)} numbers, needs {wanted}")
            rows.append(found)
            _checked(_pose(found, rows[0], where), where)
    if not rows:
        raise ConfigError(f"{files[0]}: line 1: there is no pose")
    return Track(np.stack([_pose(row, rows[0], "") for row in rows]))


def _pose(row: list[float], first: list[float], where: str) -> Floats:
    if len(row) == _EMP:
        return np.array(row)
    if len(row) == _OXTS:
        return np.array(
            [*(_mercator(row, first, where) - _mercator(first, first, where)), *row[3:6]]
        )
    matrix = np.array(row).reshape(3, 4)
    rotation = matrix[:, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ConfigError(f"{where}: the 12 numbers are no rows of [R|t]: R is no rotation")
    return SE3(rotation, matrix[:, 3]).as_pose()


def _mercator(row: list[float], first: list[float], where: str) -> Floats:
    """Returns x, y, z in m (3,) of latitude and longitude in deg, as KITTI's own tools do it."""
    latitude, longitude, altitude_m = row[:3]
    if not (abs(latitude) < 89 and abs(longitude) <= 360):
        raise ConfigError(f"{where}: latitude {latitude:g}, longitude {longitude:g} deg cannot be")
    scale = np.cos(np.radians(first[0]))
    y = scale * _EARTH_M * np.log(np.tan(np.radians(90 + latitude) / 2))
    return np.array([scale * _EARTH_M * np.radians(longitude), y, altitude_m])


def _checked(pose: Floats, where: str) -> Floats:
    if not (np.abs(pose) <= MOST).all():
        raise ConfigError(f"{where}: a pose lies beyond 1e7 m or 1e3 rad")
    return pose
