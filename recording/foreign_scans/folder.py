"""Files of a folder of scans: finds the agent, sensor and frame of each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from perception.detector import LIDAR
from protocol.errors import ConfigError
from sensing.point_files import point_files

_AFTER_NAME = "-_."


def agent_name(folder: Path) -> str:
    """Returns the name of the one agent of a folder: the folder's, unless that is what boxes have.

    Argoverse 2 calls its folders so.
    """
    name = folder.resolve().name
    return name if name and name != LIDAR else "agent"


def by_agent(folder: Path, files: Iterable[Path]) -> dict[str, list[Path]]:
    """Returns files in order by agent: the first folder below, or this one where there is none.

    Where two folders below would have one name, their whole paths distinguish them.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    for file in sorted(files):
        groups.setdefault(file.relative_to(folder).parent.parts, []).append(file)
    if len(groups) == 1:
        return {agent_name(folder): next(iter(groups.values()))}
    short = [parts[0] if parts else folder.resolve().name for parts in groups]
    unique = len(set(short)) == len(short)
    names = short if unique else ["-".join(parts) or folder.resolve().name for parts in groups]
    return dict(zip(names, groups.values(), strict=True))


def scans_in(folder: Path) -> dict[str, list[Path]]:
    """Returns the clouds' files by agent, each list in the order of frames.

    Raises:
        ConfigError: there is none.
    """
    return by_agent(folder, point_files([folder]))


def sensors_in(folder: Path, sensors: Sequence[str]) -> dict[str, list[Path]]:
    """Returns the same by sensor: a file's folder is called like it, or its own name begins so.

    Raises:
        ConfigError: a file is of no sensor, a sensor has no file, or they have not equally many.
    """
    found: dict[str, list[Path]] = {name: [] for name in sensors}
    for file in point_files([folder]):
        fitting = [name for name in sensors if _is_of(file, folder, name)]
        if not fitting:
            raise ConfigError(
                f"{file}: is of none of the sensors {', '.join(sensors)}: neither its folder nor "
                "the beginning of its name is called like one"
            )
        found[max(fitting, key=len)].append(file)
    counts = {name: len(files) for name, files in found.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name}: {count}" for name, count in counts.items())
        raise ConfigError(f"{folder}: sensors have not equally many files ({listed})")
    return found


def _is_of(file: Path, folder: Path, sensor: str) -> bool:
    stem = file.stem
    begins = stem == sensor or (stem.startswith(sensor) and stem[len(sensor)] in _AFTER_NAME)
    return begins or sensor in file.relative_to(folder).parent.parts
