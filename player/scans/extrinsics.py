"""How sensors are mounted on their vehicle.

- CSV: columns sensor, x_m, y_m, z_m and, if you like, roll_deg, pitch_deg, yaw_deg.
- OpenCalib's text: blocks of `device_id: N` and `(Roll,Pitch,Yaw,tx,ty,tz): …` in deg and m; what
  the devices are called is told besides, in the order of their numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from player.scans.numbers import lines_of, numbers_of
from player.scans.table import PLACE, TURN, rows_of
from protocol.errors import ConfigError
from protocol.geometry import SE3

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
