"""Rewrites SUMO's configuration files for runs that are compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from protocol.errors import ConfigError
from sim_host.netfile import open_file

PAIRED_SETTINGS: dict[str, Any] = {
    "realism": "clear",
    "mode": "lockstep",
    "traffic.lateral.lane_change_s": 0,
    "traffic.pedestrians_per_hour": 0,
}
"""Settings of a scenario whose traffic equals that of SUMO alone, as in `studies.control_run`."""
SAME_FOR_ALL = (
    *("mode", "cabinet", "traffic.step_s", "traffic.lateral.lane_change_s"),
    "traffic.pedestrians_per_hour",
)
"""Keys that must not be set, as they would change SUMO or the cabinet in only some of such runs."""
_SHORT = {"n": "net-file", "r": "route-files", "a": "additional-files", "b": "begin", "e": "end"}
_FILES = ("net-file", "route-files", "additional-files")


def write_config(source: Path, target: Path, trips: Path | None = None) -> None:
    """Writes a sumocfg anew: files by absolute paths, nobody teleported, no other outputs.

    Args:
        source: the user's, or a generated one.
        target: a file in any folder.
        trips: where SUMO is to write every journey with its emissions, also those that have not
            ended or begun.

    Raises:
        ConfigError: the source is no sumocfg.
    """
    try:
        with open_file(source) as stream:
            leaves = [one for one in ElementTree.parse(stream).getroot().iter() if not len(one)]
    except (ElementTree.ParseError, OSError) as error:
        raise ConfigError(f"{source}: cannot be read as XML: {error}") from None
    options: dict[str, str] = {}
    for one in leaves:
        value = one.get("value", one.get("v"))
        name = _SHORT.get(one.tag, one.tag)
        if value is not None and "output" not in name and not name.startswith("gui"):
            options[name] = _absolute(value, source.parent) if name in _FILES else value
    options["time-to-teleport"] = "-1"
    if trips is not None:
        options |= {
            "tripinfo-output": str(trips),
            "tripinfo-output.write-unfinished": "true",
            "tripinfo-output.write-undeparted": "true",
            "device.emissions.probability": "1",
        }
    root = ElementTree.Element("configuration")
    for name, value in options.items():
        ElementTree.SubElement(root, name, value=value)
    ElementTree.ElementTree(root).write(target)


def _absolute(names: str, folder: Path) -> str:
    return ",".join(
        str((folder / one.strip()).resolve()) for one in names.split(",") if one.strip()
    )
