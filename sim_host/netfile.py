"""Reader of SUMO net files, gzipped or not."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from xml.etree import ElementTree

from protocol.config import is_file
from protocol.errors import ConfigError
from protocol.roadmap import PlanPhase
from sim_host.limits import MAX_ID_CHARS

_Stream = BufferedReader | gzip.GzipFile
UNREADABLE = (ElementTree.ParseError, OSError, EOFError, zlib.error)
"""Exceptions that reading such a file as XML raises if it is damaged."""


def open_file(path: Path) -> _Stream:
    """Opens a file; one that is gzipped, by its name, is unpacked as it is read."""
    return gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb")


Point = tuple[float, float, float]
_NOT_IN_IDS = frozenset(" \t\n\r|\\'\";,<>&*?")  # for SUMO they end or divide names
_WALKS = {"crossing", "walkingarea"}
TURNAROUND_DEG = 170.0  # a connection that turns so far is a U-turn
_ROAD_CLASSES = {"passenger", "private", "taxi", "bus", "coach", "delivery", "truck", "trailer"}


@dataclass(frozen=True, slots=True)
class NetLane:
    """One `<lane>`; `drivable` is False for rails, paths and pavements."""

    id: str
    edge: str
    width_m: float
    speed_mps: float
    length_m: float
    shape: list[Point]
    internal: bool
    drivable: bool
    passenger: bool


@dataclass(frozen=True, slots=True)
class NetConnection:
    """One `<connection>` between lanes; `tls` is empty where no signal controls it."""

    from_lane: str
    to_lane: str
    via: str
    tls: str
    link: int


@dataclass(frozen=True, slots=True)
class NetJunction:
    """One `<junction>`; `foes[i]` and `responses[i]` are bit strings, link 0 rightmost."""

    id: str
    centre: Point
    shape: list[Point]
    incoming_lanes: list[str]
    internal_lanes: list[str]
    foes: dict[int, str]
    responses: dict[int, str]


@dataclass(slots=True)
class Net:
    """Everything of a net file that cpnet uses."""

    path: Path
    lanes: dict[str, NetLane] = field(default_factory=dict)
    edges: dict[str, list[str]] = field(default_factory=dict)
    connections: list[NetConnection] = field(default_factory=list)
    junctions: dict[str, NetJunction] = field(default_factory=dict)
    programs: dict[str, tuple[float, list[PlanPhase]]] = field(default_factory=dict)

    def turn_deg(self, connection: NetConnection) -> float:
        """Returns by how much the heading changes over a connection, 0 to 180."""
        before = self.lanes[connection.from_lane].shape[-2:]
        after = self.lanes[connection.to_lane].shape[:2]
        return abs(math.degrees(math.remainder(_heading(after) - _heading(before), math.tau)))


def _heading(points: Sequence[Point]) -> float:
    (ax, ay, _), (bx, by, _) = points[0], points[-1]
    return math.atan2(by - ay, bx - ax)


def read_net(path: Path) -> Net:
    """Reads a net file, gzipped or not.

    Raises:
        ConfigError: the file is missing, is not XML or holds no net.
    """
    if not is_file(path):
        raise ConfigError(f"net file {path} does not exist; expected a SUMO .net.xml")
    net = Net(path)
    try:
        with open_file(path) as stream:
            for element in _children(stream, path):
                _take(net, element)
    except UNREADABLE as error:
        raise ConfigError(f"net file {path} cannot be read as XML: {error}") from None
    except KeyError as error:
        raise ConfigError(f"net file {path} is not a valid SUMO net: lacks {error}") from None
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"net file {path} is not a valid SUMO net: {error}") from None
    if not net.lanes:
        raise ConfigError(f"net file {path} holds no lanes; expected a SUMO .net.xml")
    return net


def _children(stream: _Stream, path: Path) -> Iterator[ElementTree.Element]:
    """Yields the root's children as they are complete, and frees them: city nets are large."""
    depth = 0
    root: ElementTree.Element | None = None
    for event, element in ElementTree.iterparse(stream, ("start", "end")):
        depth += 1 if event == "start" else -1
        if root is None:
            root = element
            if root.tag != "net":
                raise ConfigError(f"file {path} holds <{root.tag}>, expected a SUMO <net>")
        elif event == "end" and depth == 1:
            yield element
            root.clear()


def _take(net: Net, element: ElementTree.Element) -> None:
    if element.tag == "edge" and element.get("function") not in _WALKS:
        lanes = [_lane(lane, element) for lane in element.iter("lane")]
        net.lanes.update((lane.id, lane) for lane in lanes)
        net.edges[_id(element)] = [lane.id for lane in lanes]
    elif element.tag == "connection":
        net.connections.append(_connection(element))
    elif element.tag == "junction" and element.get("type") != "internal":
        junction = _junction(element)
        net.junctions[junction.id] = junction
    elif element.tag == "tlLogic":
        phases = [
            PlanPhase(duration_s=_number(phase.attrib["duration"]), state=phase.attrib["state"])
            for phase in element.iter("phase")
        ]
        net.programs[element.attrib["id"]] = (_number(element.get("offset")), phases)


def _lane(lane: ElementTree.Element, edge: ElementTree.Element) -> NetLane:
    allowed = _allowed(lane)
    return NetLane(
        id=_id(lane),
        edge=_id(edge),
        width_m=_number(lane.get("width", "3.2")),  # SUMO's default
        speed_mps=_number(lane.attrib["speed"]),
        length_m=_number(lane.attrib["length"]),
        shape=_shape(lane.attrib["shape"]),
        internal=edge.get("function") == "internal",
        drivable=bool(allowed),
        passenger="passenger" in allowed,
    )


def _allowed(lane: ElementTree.Element) -> set[str]:
    """Returns the road classes that may use the lane."""
    if "allow" in lane.attrib:
        words = set(lane.attrib["allow"].split())
        return _ROAD_CLASSES if "all" in words else _ROAD_CLASSES & words
    words = set(lane.get("disallow", "").split())
    return set() if "all" in words else _ROAD_CLASSES - words


def _connection(element: ElementTree.Element) -> NetConnection:
    a = element.attrib
    link = int(a.get("linkIndex", -1))
    if a.get("tl") and link < 0:
        raise ValueError(
            f"the connection from {a['from']} to {a['to']} at signal {a['tl']} has the linkIndex "
            f"{link}, needs 0 or more"
        )
    return NetConnection(
        from_lane=f"{a['from']}_{a['fromLane']}",
        to_lane=f"{a['to']}_{a['toLane']}",
        via=a.get("via", ""),
        tls=a.get("tl", ""),
        link=link,
    )


def _junction(element: ElementTree.Element) -> NetJunction:
    a = element.attrib
    requests = list(element.iter("request"))
    return NetJunction(
        id=a["id"],
        centre=(_number(a["x"]), _number(a["y"]), _number(a.get("z"))),
        shape=_shape(a.get("shape", "")),
        incoming_lanes=a.get("incLanes", "").split(),
        internal_lanes=a.get("intLanes", "").split(),
        foes={int(r.attrib["index"]): r.attrib["foes"] for r in requests},
        responses={int(r.attrib["index"]): r.attrib["response"] for r in requests},
    )


def _shape(text: str) -> list[Point]:
    points = []
    for word in text.split():
        x, y, *z = (_number(number) for number in word.split(","))
        points.append((x, y, z[0] if z else 0.0))
    return points


def _id(element: ElementTree.Element) -> str:
    name = element.attrib["id"]
    if not 0 < len(name) <= MAX_ID_CHARS or _NOT_IN_IDS & set(name):
        raise ValueError(
            f"the {element.tag} id {name!r:.80} has {len(name)} characters, allowed are 1 to "
            f"{MAX_ID_CHARS} without spaces and any of {' '.join(sorted(_NOT_IN_IDS)[3:])}"
        )
    return name


def _number(text: str | None) -> float:
    value = float(text) if text else 0.0
    if not math.isfinite(value):
        raise ValueError(f"the number {text!r:.80} is not finite")
    return value
