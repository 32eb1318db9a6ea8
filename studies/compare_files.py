"""Files that `cpnet compare` is given: what can be refused at once, by the option that named it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from protocol.config import is_file, is_folder
from protocol.errors import ConfigError
from sim_host.netfile import UNREADABLE, open_file

Files = Mapping[str, Path | None]
"""By option; None where the option is not given."""
_ROOTS = {
    "net": ("net", "--net"),
    "routes": ("route file", "--net with --routes"),
    "configuration": ("sumocfg", "--sumocfg"),
}
"""What a file is, and the option that takes it, by its first element."""
_TAKEN = {"--net": "net", "--sumocfg": "configuration", "--routes": "routes"}
_DRIVING = ("vehicle", "trip", "flow")


def check_no_folders(files: Files) -> None:
    """Refuses folders.

    Raises:
        ConfigError: one of the files is a folder.
    """
    for option, path in files.items():
        if path is not None and is_folder(path):
            raise ConfigError(f"{option} {path}: is a folder; name a file in it")


def check_contents(files: Files) -> None:
    """Refuses files of another kind than their option takes, and routes on which nobody drives.

    Raises:
        ConfigError: a file is missing, is not XML, is of another kind, or holds no vehicle.
    """
    for option, path in files.items():
        if path is not None:
            _check_kind(option, path)


def _check_kind(option: str, path: Path) -> None:
    if not is_file(path):
        raise ConfigError(f"{option} {path}: there is no such file")
    try:
        root, drives = _look_into(path, whole=option == "--routes")
    except UNREADABLE as error:
        raise ConfigError(f"{option} {path}: cannot be read as XML: {error}") from None
    if root != _TAKEN[option] and root in _ROOTS:
        kind, other = _ROOTS[root]
        raise ConfigError(f"{option} {path}: is a {kind}; use {other}")
    if option == "--routes" and not drives:
        raise ConfigError(f"{option} {path}: holds no vehicle, trip or flow; nobody would drive")


def _look_into(path: Path, *, whole: bool) -> tuple[str, bool]:
    """Returns a file's first element, and if the `whole` is read, whether vehicles are in it.

    It ends at the first vehicle: route files of a city are large.
    """
    first: ElementTree.Element | None = None
    with open_file(path) as stream:
        for event, element in ElementTree.iterparse(stream, ("start", "end")):
            first = element if first is None else first
            if element.tag in _DRIVING:
                return first.tag, True
            if not whole:
                break
            if event == "end":
                element.clear()
    return ("" if first is None else first.tag), False
