"""Readers of poses and extrinsics: CSV, EMP, TUM, KITTI, Argoverse 2, OpenCalib.

A pose is that of the sensor, or of the vehicle where extrinsics give how sensors are mounted on it.

- CSV: columns x_m, y_m, z_m and, optionally, roll_deg, pitch_deg, yaw_deg (0), time_s, agent. One
  line per frame and agent.
- Text: one line per frame with 6 numbers, x y z roll pitch yaw in m and rad (EMP, MobiCom 2021);
  with 8, TUM's time in s, x y z and the quaternion x y z w; with 12, the rows of [R|t], map from
  sensor; or with 30, a line of KITTI's oxts, of which latitude, longitude, altitude, roll, pitch
  and yaw are used: the first pose is the origin, x east, y north.
- Feather: Argoverse 2's `city_SE3_egovehicle.feather`: timestamp_ns, qw, qx, qy, qz, tx_m, ty_m,
  tz_m.
- A folder: its .txt files in order, one line each, as KITTI's oxts/data; of several agents one
  folder each.

Extrinsics, how sensors are mounted on their vehicle:

- CSV: columns sensor, x_m, y_m, z_m and, optionally, roll_deg, pitch_deg, yaw_deg.
- OpenCalib's text: blocks of `device_id: N` and `(Roll,Pitch,Yaw,tx,ty,tz): …` in deg and m; the
  names of the devices are given separately, in the order of their numbers.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocol.config import is_file, is_folder
from protocol.errors import ConfigError
from protocol.geometry import SE3, Floats
from recording.foreign_scans.folder import by_agent
from recording.limits import MAX_POSE_FILE_BYTES
from sensing.feather import read_feather


def lines_of(path: Path) -> list[str]:
    """Returns the lines of a text file.

    Raises:
        ConfigError: it cannot be read, or is too large.
    """
    try:
        if path.stat().st_size > MAX_POSE_FILE_BYTES:
            raise ConfigError(
                f"{path} has {path.stat().st_size} bytes, limit {MAX_POSE_FILE_BYTES}"
            )
        return path.read_text("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def numbers_of(words: Sequence[str | None], where: str) -> list[float]:
    """Returns finite numbers of words; `where` begins the text of an error.

    Raises:
        ConfigError: a word is none.
    """
    found = []
    for word in words:
        try:
            number = float(word or "")
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ConfigError(f"{where}: {word!r:.40} is no finite number")
        found.append(number)
    return found


PLACE = ("x_m", "y_m", "z_m")
TURN = ("roll_deg", "pitch_deg", "yaw_deg")
"""May be left out: 0."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRow:
    """One line: a pose (6,) in m and rad, the other columns as text, and where it stands."""

    where: str
    pose: Floats
    others: dict[str, str]


def rows_of(path: Path, others: Sequence[str]) -> Iterator[PoseRow]:
    """Yields the rows of a table of poses; of `others`, the columns that are there.

    Raises:
        ConfigError: the file cannot be read, lacks a column, or a line of it is wrong.
    """
    lines = lines_of(path)
    reader = csv.DictReader(lines, skipinitialspace=True)
    try:
        names = [name.strip() for name in reader.fieldnames or []]
        reader.fieldnames = names
        _check_names(names, [*PLACE, *TURN, *others], path)
        for line in reader:
            where = f"{path}: line {reader.line_num}"
            if None in line:  # where the reader puts what has no column
                raise ConfigError(f"{where}: has more fields than the {len(names)} columns")
            yield PoseRow(
                where,
                _row_pose(line, where),
                {n: (line[n] or "").strip() for n in others if n in names},
            )
    except csv.Error as error:  # it has not counted the line that it failed on
        raise ConfigError(f"{path}: line {reader.line_num + 1}: {error}") from None


def _check_names(names: Sequence[str], allowed: Sequence[str], path: Path) -> None:
    if missing := [name for name in PLACE if name not in names]:
        raise ConfigError(f"{path}: line 1: lacks the column {missing[0]}")
    if odd := [name for name in names if name not in allowed]:
        raise ConfigError(
            f"{path}: line 1: unknown column {odd[0]!r:.40}; allowed: {', '.join(allowed)}"
        )
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{path}: line 1: has the column {twice[0]} twice")


def _row_pose(line: dict[str, str | None], where: str) -> Floats:
    turn = [line.get(name, "0") for name in TURN]
    numbers = numbers_of([*(line[name] for name in PLACE), *turn], where)
    return np.array([*numbers[:3], *np.radians(numbers[3:])])


LATEST_S = 1e10
MAX_POSE = np.array([1e7, 1e7, 1e7, 1e3, 1e3, 1e3])  # m, rad: as messages take
_EARTH_M = 6_378_137.0
_EMP, _TUM, _MATRIX, _OXTS = 6, 8, 12, 30
_QUATERNION_OFF = 0.01  # from length 1
_AV2 = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_AV2_TIME = "timestamp_ns"


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """An agent's poses (N, 6) in the map frame, and their times in s (N,), None if not given.

    `clock`: whether the times are those of a clock that files may be named by.
    """

    poses: Floats
    times_s: Floats | None = None
    clock: bool = False

    def at(self, times_s: Floats, within_s: float) -> Track | None:
        """Returns the poses nearest to times (N,); None if one is farther off, or none is given."""
        if self.times_s is None or not self.clock:
            return None
        after = np.searchsorted(self.times_s, times_s).clip(1, max(len(self.times_s) - 1, 1))
        both = np.stack([after - 1, after.clip(0, len(self.times_s) - 1)])
        nearest = both[np.abs(self.times_s[both] - times_s).argmin(axis=0), np.arange(len(after))]
        if (np.abs(self.times_s[nearest] - times_s) > within_s).any():
            return None
        return Track(self.poses[nearest], self.times_s[nearest], clock=True)


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
    if path.suffix.lower() == ".feather":
        return {"": _feather_track(path)}
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
            if abs(time_s) > LATEST_S or (before and time_s <= before[-1]):
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
            known = (_EMP, _TUM, _MATRIX, _OXTS)
            if len(found) not in known or (rows and len(found) != len(rows[0])):
                wanted = str(len(rows[0])) if rows else "6, 8 (TUM), 12 (KITTI) or 30"
                raise ConfigError(f"{where}: has {len(found)} numbers, needs {wanted}")
            rows.append(found)
            _checked(_pose(found, rows[0], where), where)
    if not rows:
        raise ConfigError(f"{files[0]}: line 1: there is no pose")
    poses = np.stack([_pose(row, rows[0], "") for row in rows])
    if len(rows[0]) != _TUM:
        return Track(poses)
    times_s = np.array([row[0] for row in rows])
    _check_times(times_s, str(files[0]))
    return Track(poses, times_s, clock=True)


def _check_times(times_s: Floats, where: str) -> None:
    if (np.abs(times_s) > LATEST_S).any() or (np.diff(times_s) <= 0).any():
        raise ConfigError(f"{where}: times must ascend, and be {LATEST_S:g} s at most")


def _feather_track(path: Path) -> Track:
    """Reads the poses of Argoverse 2's ego vehicle."""
    if not is_file(path):
        raise ConfigError(f"{path} does not exist")
    if path.stat().st_size > MAX_POSE_FILE_BYTES:
        raise ConfigError(f"{path} has {path.stat().st_size} bytes, limit {MAX_POSE_FILE_BYTES}")
    try:
        columns = read_feather(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    wanted = (_AV2_TIME, *_AV2)
    if missing := [name for name in wanted if name not in columns]:
        raise ConfigError(
            f"{path}: lacks a column {missing[0]} of numbers; needs {', '.join(wanted)}"
        )
    order = np.argsort(columns[_AV2_TIME], kind="stable")
    if not len(order):
        raise ConfigError(f"{path}: holds no pose")
    rows = np.stack([columns[name].astype(np.float64)[order] for name in _AV2], axis=1)
    poses = [
        _checked(_turned(row[4:7], row[[1, 2, 3, 0]], f"{path}: row {n}"), f"{path}: row {n}")
        for n, row in enumerate(rows)
    ]
    times_s = columns[_AV2_TIME].astype(np.float64)[order] / 1e9
    _check_times(times_s, str(path))
    return Track(np.stack(poses), times_s, clock=True)


def _turned(place_m: Floats, quaternion: Floats, where: str) -> Floats:
    """Returns the pose (6,) of a place (3,) and a quaternion x, y, z, w (4,)."""
    length = float(np.linalg.norm(quaternion))
    if not (abs(length - 1) < _QUATERNION_OFF and np.isfinite(place_m).all()):
        raise ConfigError(f"{where}: the quaternion's length is {length:g}, must be 1")
    x, y, z, w = quaternion / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return SE3(rotation, place_m).as_pose()


def _pose(row: list[float], first: list[float], where: str) -> Floats:
    if len(row) == _EMP:
        return np.array(row)
    if len(row) == _TUM:
        return _turned(np.array(row[1:4]), np.array(row[4:]), where)
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
    if not (np.abs(pose) <= MAX_POSE).all():
        raise ConfigError(f"{where}: a pose lies beyond 1e7 m or 1e3 rad")
    return pose


_DEVICE, _POSE = "device_id:", "(Roll,Pitch,Yaw,tx,ty,tz):"


def read_extrinsics(path: Path, names: Sequence[str]) -> dict[str, SE3]:
    """Returns `vehicle_SE3_sensor` by sensor; `names` are for files that number their devices.

    Raises:
        ConfigError: the file cannot be read, or a line of it; names file and line.
    """
    if path.suffix.lower() != ".csv":
        return _read_devices(path, names)
    found: dict[str, SE3] = {}
    for row in rows_of(path, ("sensor",)):
        name = row.others.get("sensor", "")
        if not name or name in found:
            raise ConfigError(f"{row.where}: sensor is {name!r:.40}, each needs a name of its own")
        found[name] = SE3.from_pose(row.pose)
    if not found:
        raise ConfigError(f"{path}: line 2: no sensor follows the column names")
    return found


def write_extrinsics(path: Path, mounts: Mapping[str, SE3]) -> None:
    """Writes a table that `read_extrinsics` reads."""
    lines = [",".join(("sensor", *PLACE, *TURN))]
    for name, mount in mounts.items():
        pose = mount.as_pose()
        numbers = [*pose[:3], *np.degrees(pose[3:])]
        lines.append(",".join([name, *(f"{number:.4f}" for number in numbers)]))
    path.write_text("\n".join(lines) + "\n", "utf-8")


def _read_devices(path: Path, names: Sequence[str]) -> dict[str, SE3]:
    found: dict[str, SE3] = {}
    name = ""
    for number, line in enumerate(lines_of(path), 1):
        text, where = line.strip(), f"{path}: line {number}"
        if text.startswith(_DEVICE):
            name = _name_of(text.removeprefix(_DEVICE).strip(), names, where)
        elif text.startswith(_POSE):
            turn_and_place = numbers_of(text.removeprefix(_POSE).split(), where)
            if len(turn_and_place) != 6 or not name or name in found:
                raise ConfigError(f"{where}: needs six numbers, once for each {_DEVICE} N")
            turn, place = np.radians(turn_and_place[:3]), turn_and_place[3:]
            found[name] = SE3.from_pose([*place, *turn])
        elif text:
            raise ConfigError(f"{where}: {text!r:.40} is neither {_DEVICE} N nor {_POSE} …")
    if len(found) != len(names):
        raise ConfigError(
            f"{path}: has {len(found)} devices, --sensors names {len(names)}: give a name for "
            "each, in the order of their numbers"
        )
    return found


def _name_of(device: str, names: Sequence[str], where: str) -> str:
    if not device.isdigit() or len(device) > 4 or int(device) >= len(names):
        raise ConfigError(
            f"{where}: device {device!r:.40} has no name: give --sensors NAME,… in the order of "
            f"the devices' numbers, such as --sensors top,left,right (got {len(names)})"
        )
    return names[int(device)]
