"""Nets made with netconvert: the built-in T junction, and random signalised junctions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np
from pydantic import Field

from protocol.config import Section
from protocol.geometry import Floats
from sim_host.sumo import netconvert

Row = dict[str, str | int | float]

_SUFFIXES = {"node": "nod", "edge": "edg", "connection": "con"}
_HEADER = re.compile(r"<!-- generated on .*?-->\s*", re.DOTALL)


def write_plain_net(
    folder: Path, name: str, parts: Mapping[str, Sequence[Row]], signal: str | None = None
) -> Path:
    """Writes `NAME.net.xml` into the folder, by way of netconvert.

    The same parts give the same bytes: netconvert's header, which holds the time, is removed.

    Args:
        folder: holds the plain files as well.
        name: of the net.
        parts: rows by their tag: node, edge, connection. Without connections netconvert guesses.
        signal: the text of a file of signal plans; without one, netconvert makes a plan.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    arguments = []
    for tag, rows in parts.items():
        path = folder / f"{name}.{_SUFFIXES[tag]}.xml"
        path.write_text(xml(f"{tag}s", [(tag, row) for row in rows]), encoding="utf-8")
        arguments += [f"--{tag}-files", str(path)]
    if signal is not None:
        path = folder / f"{name}.tll.xml"
        path.write_text(signal, encoding="utf-8")
        arguments += ["--tllogic-files", str(path)]
    net = folder / f"{name}.net.xml"
    netconvert([*arguments, "--output-file", str(net)])
    net.write_text(_HEADER.sub("", net.read_text("utf-8"), count=1), encoding="utf-8")
    return net


def xml(root: str, rows: Sequence[tuple[str, Row]], before: str = "") -> str:
    """Returns rows of (tag, attributes) under a root; `before` stands first."""
    lines = [
        f"  <{tag} " + " ".join(f"{k}={quoteattr(str(v))}" for k, v in row.items()) + "/>"
        for tag, row in rows
    ]
    return "\n".join([f"<{root}>", before, *lines, f"</{root}>", ""])


TLS = "J"
SPEED_MPS = 13.89
LANE_WIDTH_M = 3.5
DEMAND_VPH_PER_LANE = {"north_in": 360.0}  # the paper's side road; 500 elsewhere
_CORNER_RADIUS_M = 12.0
_STOP_M = {"west": 19.0, "east": 12.0, "north": 26.0}  # where netconvert then puts the stop bars
_LENGTH_M = {"west": 193.0, "east": 237.0, "north": 431.0}  # of the approaches
_CLIMB_FROM_M, _CLIMB_M = 80.0, 2.0


def write_net(folder: Path) -> Path:
    """Writes `t_junction.net.xml` into the folder, by way of netconvert.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    parts = {"node": _nodes(), "edge": _edges(), "connection": _connections()}
    return write_plain_net(folder, "t_junction", parts, _signal_xml())


def _end_m(arm: str) -> float:
    return _STOP_M[arm] + _LENGTH_M[arm]


def _nodes() -> list[Row]:
    junction: Row = {"id": TLS, "x": 0, "y": 0, "z": 0, "type": "traffic_light", "tl": TLS}
    return [
        {**junction, "radius": _CORNER_RADIUS_M},
        {"id": "west", "x": -_end_m("west"), "y": 0, "z": 0},
        {"id": "east", "x": _end_m("east"), "y": 0, "z": _CLIMB_M},
        {"id": "north", "x": 0, "y": _end_m("north"), "z": 0},
    ]


def _edges() -> list[Row]:
    slope = [f"{_end_m('east')},0,{_CLIMB_M}", f"{_CLIMB_FROM_M},0,0", "0,0,0"]
    main: Row = {"numLanes": 4, "speed": SPEED_MPS, "width": LANE_WIDTH_M}
    east: Row = {**main, "id": "east_in", "from": "east", "to": TLS, "shape": " ".join(slope)}
    slope.reverse()
    return [
        {**main, "id": "west_in", "from": "west", "to": TLS},
        {**main, "id": "west_out", "from": TLS, "to": "west"},
        east,
        {**main, "id": "east_out", "from": TLS, "to": "east", "shape": " ".join(slope)},
        {**main, "id": "north_in", "from": "north", "to": TLS, "numLanes": 2},
    ]


def _connections() -> list[Row]:
    pairs = [("north_in", 0, "west_out", 0)]
    pairs += [("north_in", 1, "east_out", lane) for lane in range(4)]
    pairs += [("east_in", lane, "west_out", lane) for lane in range(4)]
    pairs += [("west_in", lane, "east_out", lane) for lane in range(4)]
    return [{"from": a, "fromLane": b, "to": c, "toLane": d} for a, b, c, d in pairs]


def _signal_xml() -> str:
    """The side road's five links come first, then the main road's eight."""
    phases = [
        (41, "rrrrrGGGGGGGG"),
        (4, "rrrrryyyyyyyy"),
        (1, "rrrrrrrrrrrrr"),
        (39, "GGGGGrrrrrrrr"),
        (4, "yyyyyrrrrrrrr"),
        (1, "rrrrrrrrrrrrr"),
    ]
    body = "".join(f'<phase duration="{s}" state="{state}"/>' for s, state in phases)
    links = [
        ("connection", {**row, "tl": TLS, "linkIndex": link})
        for link, row in enumerate(_connections())
    ]
    logic = f'<tlLogic id="{TLS}" type="static" programID="0" offset="0">{body}</tlLogic>'
    return xml("tlLogics", links, logic)


Kind = Literal["tee", "cross", "fork", "skewed tee", "skewed cross"]

_KINDS: dict[Kind, tuple[tuple[float, ...], float, float]] = {  # bearings, jitter, share
    "tee": ((0, 180, 90), 5, 0.25),
    "cross": ((0, 180, 90, 270), 5, 0.3),
    "fork": ((0, 120, 240), 12, 0.1),
    "skewed tee": ((0, 180, 90), 30, 0.15),
    "skewed cross": ((0, 180, 90, 270), 22, 0.2),
}
_STRAIGHT_M = 30.0  # from the centre, before an arm bends or climbs
_STEP_M = 10.0
_CREST_M = 40.0  # over which a grade begins
_SPEEDS_MPS = (8.33, 11.11, 13.89, 16.67)
_GAP_M = 8.0  # between the borders of two arms, at least
_APART_M = 45.0  # from the centre; nearer, arms come together
_TRIES = 20


class Arm(Section):
    """A road that ends at the junction. `lanes_in` lead to it, `lanes_out` away; one may be 0."""

    name: str
    bearing_deg: float = Field(description="from the centre outwards, CCW from east")
    turn_deg: float = Field(description="by how much it has bent at its end, CCW")
    grade: float = Field(description="climb a metre outwards")
    length_m: float
    lanes_in: int
    lanes_out: int
    lane_width_m: float
    speed_mps: float

    @property
    def width_m(self) -> float:
        """Over all lanes."""
        return (self.lanes_in + self.lanes_out) * self.lane_width_m

    @property
    def line(self) -> Floats:
        """The middle (K, 3) from the junction's centre outwards."""
        way = np.append(np.arange(0.0, self.length_m, _STEP_M), self.length_m)
        beyond = np.maximum(way - _STRAIGHT_M, 0.0)
        bent = np.radians(self.turn_deg) * beyond / (self.length_m - _STRAIGHT_M)
        heading = np.radians(self.bearing_deg) + bent
        step = np.diff(way)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])[1:]
        climb = np.where(
            beyond < _CREST_M, beyond**2 / (2 * _CREST_M), np.maximum(beyond - _CREST_M / 2, 0.0)
        )
        flat = np.vstack([np.zeros(2), np.cumsum(step, axis=0)])
        return np.column_stack([flat, self.grade * climb])


class Junction(Section):
    """A signalised junction at (0, 0, 0) and the roads that meet there."""

    kind: Kind
    corner_radius_m: float
    arms: list[Arm]

    @property
    def parts(self) -> bool:
        """Whether the arms keep apart once they have left the junction."""
        for a, b in combinations(self.arms, 2):
            gaps = np.linalg.norm(a.line[:, None, :2] - b.line[None, :, :2], axis=2)
            far = [np.linalg.norm(arm.line[:, :2], axis=1) > _APART_M for arm in (a, b)]
            if gaps[far[0]][:, far[1]].min() < (a.width_m + b.width_m) / 2 + _GAP_M:
                return False
        return True


def draw_junction(rng: np.random.Generator) -> Junction:
    """Draws a junction; arms bend by less, the more tries it takes to keep them apart."""
    for tried in range(_TRIES):
        junction = _draw(rng, 1 - tried / _TRIES)
        if junction.parts:
            return junction
    return _draw(rng, 0.0)


def write_junction(folder: Path, name: str, junction: Junction) -> Path:
    """Writes `NAME.net.xml` into the folder; netconvert chooses who may turn where, and a plan.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    centre: Row = {"id": TLS, "x": 0, "y": 0, "z": 0, "type": "traffic_light", "tl": TLS}
    nodes = [{**centre, "radius": junction.corner_radius_m}]
    edges: list[Row] = []
    for arm in junction.arms:
        line = arm.line.round(2)
        nodes.append({"id": arm.name} | dict(zip("xyz", line[-1].tolist(), strict=True)))
        one_way = not (arm.lanes_in and arm.lanes_out)
        both: Row = {
            "speed": arm.speed_mps,
            "width": arm.lane_width_m,
            "spreadType": "center" if one_way else "right",
        }
        ways = (
            ("in", arm.name, TLS, arm.lanes_in, line[::-1]),
            ("out", TLS, arm.name, arm.lanes_out, line),
        )
        edges += [
            {
                **both,
                "id": f"{arm.name}_{way}",
                "from": start,
                "to": end,
                "numLanes": lanes,
                "shape": " ".join(f"{x},{y},{z}" for x, y, z in shape.tolist()),
            }
            for way, start, end, lanes, shape in ways
            if lanes
        ]
    return write_plain_net(folder, name, {"node": nodes, "edge": edges})


def _draw(rng: np.random.Generator, wildness: float) -> Junction:
    kinds = list(_KINDS)
    kind = kinds[rng.choice(len(kinds), p=[_KINDS[k][2] for k in kinds])]
    middles, jitter_deg, _ = _KINDS[kind]
    jitter_deg *= max(wildness, 0.1)
    turned_deg = rng.uniform(0, 360)
    width_m, hilly = round(rng.uniform(2.9, 3.75), 2), rng.random() < 0.5
    roads = [_Road(rng, most=4), _Road(rng, most=3)]
    one_way = int(rng.choice([0, 1, -1], p=[0.75, 0.125, 0.125]))  # of the second road
    arms = []
    for n, middle_deg in enumerate(middles):
        road = roads[n // 2]
        lanes_in, lanes_out = road.lanes if n % 2 == 0 else road.lanes[::-1]
        if one_way and n >= 2:
            into = (one_way > 0) == (n == 2)
            lanes_in, lanes_out = (max(road.lanes), 0) if into else (0, max(road.lanes))
        bends, climbs = rng.random() < 0.45, hilly and rng.random() < 0.7
        arm = Arm(
            name=f"arm{n}",
            bearing_deg=round((turned_deg + middle_deg + rng.uniform(-1, 1) * jitter_deg) % 360, 2),
            turn_deg=round(rng.uniform(-60, 60) * wildness, 2) if bends else 0.0,
            grade=round(rng.uniform(-0.05, 0.05), 4) if climbs else 0.0,
            length_m=round(rng.uniform(180, 280), 1),
            lanes_in=lanes_in,
            lanes_out=lanes_out,
            lane_width_m=width_m,
            speed_mps=road.speed_mps,
        )
        arms.append(arm)
    return Junction(kind=kind, corner_radius_m=round(rng.uniform(4, 14), 1), arms=arms)


class _Road:
    """What the two arms of a road share: lanes one way and the other, and the speed."""

    def __init__(self, rng: np.random.Generator, most: int) -> None:
        there = int(rng.integers(1, most + 1))
        back = there if rng.random() < 0.7 else int(rng.integers(1, most + 1))
        self.lanes = (there, back)
        self.speed_mps = float(rng.choice(_SPEEDS_MPS))
