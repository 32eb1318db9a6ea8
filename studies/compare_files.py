"""Early checks of the files given to `cpnet compare`, by the option that named them."""

from __future__ import annotations

import re
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
"""Kind of a file, and the option that takes it, by its first element."""
_TAKEN = {"--net": "net", "--sumocfg": "configuration", "--routes": "routes"}
_DRIVING = ("vehicle", "trip", "flow")
_MOST_A_SECOND = 2.0  # vehicles of one flow: more than two lanes of a motorway carry
_RANDOM_PERIOD = re.compile(r"exp\(([0-9.eE+-]+)\)")


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


def check_flows(path: Path, until_s: float) -> None:
    """Refuses implausible flows of a route file: another unit, or over before the run is.

    Raises:
        ConfigError: a flow has more vehicles a second than a road carries, or all flows, and there
            is nothing else, end before `until_s`.
    """
    ends_s, others = [], False
    with open_file(path) as stream:
        for _, element in ElementTree.iterparse(stream):
            if element.tag == "flow":
                _check_rate(path, element)
                ends_s.append(_number(element.get("end")))
            others |= element.tag in ("vehicle", "trip")
            element.clear()
    known_s = [one for one in ends_s if one is not None]
    if known_s and len(known_s) == len(ends_s) and not others and max(known_s) < until_s:
        raise ConfigError(
            f"--routes {path}: its last flow ends at {max(known_s):g} s, before warm-up and run do "
            f"({until_s:g} s)"
        )


def _check_rate(path: Path, flow: ElementTree.Element) -> None:
    period = flow.get("period", "")
    drawn = _RANDOM_PERIOD.fullmatch(period.strip())
    rate = _number(drawn[1]) if drawn else None
    if rate is not None and rate > _MOST_A_SECOND:
        raise ConfigError(
            f"--routes {path}: flow {flow.get('id')}: period {period} are {rate:g} vehicles a "
            f"second; {rate:g} an hour are exp({rate / 3600:.4f})"
        )


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:  # a time as SUMO writes it for people, h:m:s
        return None


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
