"""Built-in nets with several signals: a corridor, a grid and an irregular town.

Every signal has a split plan: each approach has a green of its own. So all greens are protected,
which suits approaches whose left turn shares a lane with the traffic straight on (Signal Timing
Manual, 2nd edition, chapter 4: split phasing).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol
from xml.sax.saxutils import quoteattr

import numpy as np

from sensing.road import resample
from sim_host.junctions import LANE_WIDTH_M, SPEED_MPS, Row, write_plain_net, xml
from sim_host.netfile import Net, NetConnection, read_net

_ARM_M = 200.0
_CORNER_RADIUS_M = 8.0
_GREEN_S = {1: 15, 2: 20}  # by the lanes of the approach
_YELLOW_S, _ALL_RED_S = 4, 1  # those of the cabinet's defaults

_CORRIDOR_X_M = (0.0, 250.0, 540.0, 810.0, 1110.0)
_GRID_M = 200.0

_TOWN_SEED = 50  # chosen so that traffic from border to border passes every approach
_TOWN_SIZE, _TOWN_M = 6, 210.0
_TOWN_JITTER_M, _TOWN_BEND_M = 40.0, 25.0
_TOWN_DROPPED = 9  # streets of the full grid that the town lacks
_TOWN_ARMS = 0.6  # share of the border's places that have one, main streets aside
_TOWN_MAIN = ("C", "2")  # the column and the row whose streets have two lanes each way

_HILLS_SEED, _HILLS = 51, 4
_HILL_M = (500.0, 1100.0)  # from hill to hill
_STEEPER = 1.5  # the middle of a street that is level at its ends than the whole of it
_CLIMB_STEP_M = 10.0

Place = tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Street:
    """A street between two places, with so many lanes each way; `bend_m` to its left."""

    start: str
    end: str
    lanes: int
    bend_m: float = 0.0


def write_corridor(folder: Path, grade: float = 0.0) -> Path:
    """Writes `corridor.net.xml`: an arterial road, west to east, that crosses five side streets.

    Args:
        folder: gets the file.
        grade: of the steepest street, see `_heights_m`.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    crossings = [f"{letter}0" for letter in "ABCDE"]
    places = {name: (x, 0.0) for name, x in zip(crossings, _CORRIDOR_X_M, strict=True)}
    places |= {"west": (-_ARM_M, 0.0), "east": (_CORRIDOR_X_M[-1] + _ARM_M, 0.0)}
    streets = [_Street(a, b, lanes=2) for a, b in pairwise(["west", *crossings, "east"])]
    for name in crossings:
        for side, y in (("north", _ARM_M), ("south", -_ARM_M)):
            places[f"{side}{name}"] = (places[name][0], y)
            streets.append(_Street(name, f"{side}{name}", lanes=1))
    return _write(folder, "corridor", places, streets, grade)


def write_grid(folder: Path, grade: float = 0.0, size: int = 4) -> Path:
    """Writes `grid.net.xml`: crossings with two lanes each way, an arm at every border.

    Args:
        folder: gets the file.
        grade: of the steepest street, see `_heights_m`.
        size: crossings a side, 26 at most.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    places = {
        _cell(column, row): (column * _GRID_M, row * _GRID_M)
        for column in range(size)
        for row in range(size)
    }
    streets = [_Street(a, b, lanes=2) for a, b in _neighbours(size)]
    for name, side in _borders(size):
        arm = f"{side}{name}"
        places[arm] = _outwards(places[name], side)
        streets.append(_Street(name, arm, lanes=2))
    return _write(folder, "grid", places, streets, grade)


def write_town(folder: Path, grade: float = 0.0) -> Path:
    """Writes `town.net.xml`: bent streets between shifted places, a few of them missing.

    Args:
        folder: gets the file.
        grade: of the steepest street, see `_heights_m`.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    rng = np.random.default_rng(_TOWN_SEED)
    places = _town_places(rng)
    pairs = _thinned(_neighbours(_TOWN_SIZE), rng)
    has_arm = rng.random(4 * _TOWN_SIZE) < _TOWN_ARMS
    for (name, side), chosen in zip(_borders(_TOWN_SIZE), has_arm, strict=True):
        arm = f"{side}{name}"
        if chosen or _is_main(name, arm):
            places[arm] = _outwards(places[name], side)
            pairs.append((name, arm))
    bends_m = rng.uniform(-_TOWN_BEND_M, _TOWN_BEND_M, len(pairs)).round(1).tolist()
    streets = [
        _Street(a, b, lanes=2 if _is_main(a, b) else 1, bend_m=bend_m)
        for (a, b), bend_m in zip(pairs, bends_m, strict=True)
    ]
    return _write(folder, "town", places, streets, grade)


class NetworkWriter(Protocol):
    """Writes a built-in net."""

    def __call__(self, folder: Path, grade: float = 0.0) -> Path:
        """Writes the net into a folder, with hills of this grade."""


NETWORKS: dict[str, NetworkWriter] = {
    "corridor": write_corridor,
    "grid": write_grid,
    "town": write_town,
}
"""Writers of the built-in nets, by the net's name."""


def _cell(column: int, row: int) -> str:
    return f"{chr(ord('A') + column)}{row}"


def _neighbours(size: int) -> list[tuple[str, str]]:
    cells = [(column, row) for column in range(size) for row in range(size)]
    east = [(_cell(c, r), _cell(c + 1, r)) for c, r in cells if c + 1 < size]
    north = [(_cell(c, r), _cell(c, r + 1)) for c, r in cells if r + 1 < size]
    return east + north


def _borders(size: int) -> list[tuple[str, str]]:
    """Returns (crossing, side) for each place where a street could leave the grid."""
    last = size - 1
    return [
        pair
        for n in range(size)
        for pair in (
            (_cell(0, n), "west"),
            (_cell(last, n), "east"),
            (_cell(n, 0), "south"),
            (_cell(n, last), "north"),
        )
    ]


def _outwards(place: Place, side: str) -> Place:
    x, y = {"west": (-1, 0), "east": (1, 0), "south": (0, -1), "north": (0, 1)}[side]
    return place[0] + x * _ARM_M, place[1] + y * _ARM_M


def _town_places(rng: np.random.Generator) -> dict[str, Place]:
    places = {}
    for column in range(_TOWN_SIZE):
        for row in range(_TOWN_SIZE):
            x, y = rng.uniform(-_TOWN_JITTER_M, _TOWN_JITTER_M, 2).round(1).tolist()
            places[_cell(column, row)] = (column * _TOWN_M + x, row * _TOWN_M + y)
    return places


def _thinned(pairs: list[tuple[str, str]], rng: np.random.Generator) -> list[tuple[str, str]]:
    """Drops streets in random order, but no main street and none that alone joins two parts."""
    kept = list(pairs)
    dropped = 0
    for index in rng.permutation(len(pairs)):
        rest = [pair for pair in kept if pair != pairs[index]]
        if dropped < _TOWN_DROPPED and not _is_main(*pairs[index]) and _is_connected(rest, kept):
            kept, dropped = rest, dropped + 1
    return kept


def _is_main(start: str, end: str) -> bool:
    column, row = _TOWN_MAIN
    return (column in start and column in end) or (row in start and row in end)


def _is_connected(rest: list[tuple[str, str]], before: list[tuple[str, str]]) -> bool:
    """Whether the remaining streets still connect all places."""
    places = {place for pair in before for place in pair}
    found, open_ends = set[str](), [before[0][0]]
    while open_ends:
        place = open_ends.pop()
        if place not in found:
            found.add(place)
            open_ends += [b if place == a else a for a, b in rest if place in (a, b)]
    return found == places


def _write(
    folder: Path,
    name: str,
    places: Mapping[str, Place],
    streets: Sequence[_Street],
    grade: float,
) -> Path:
    """Writes the net twice: netconvert chooses and numbers the links, then takes their plans."""
    arms = Counter(place for street in streets for place in (street.start, street.end))
    heights_m = _heights_m(places, streets, grade)
    nodes = [_node(place, at, heights_m, arms[place]) for place, at in places.items()]
    edges = [
        _edge(street, places, heights_m, backwards)
        for street in streets
        for backwards in (False, True)
    ]
    parts = {"node": nodes, "edge": edges}
    net = read_net(write_plain_net(folder, name, parts))
    outside = [c for c in net.connections if not net.lanes[c.from_lane].internal]
    parts["connection"] = [_connection(c) for c in outside]
    return write_plain_net(folder, name, parts, _plans(net))


def _heights_m(
    places: Mapping[str, Place], streets: Sequence[_Street], grade: float
) -> dict[str, float]:
    """Returns the height of each place on hills, of which the steepest street has this grade.

    The hills are waves in several directions. Without a grade there is no height, and nets are
    flat.
    """
    if not grade:
        return {}
    rng = np.random.default_rng(_HILLS_SEED)
    bearing, phase = rng.uniform(0, 2 * np.pi, (2, _HILLS))
    waves_per_m = 2 * np.pi / rng.uniform(*_HILL_M, _HILLS)
    at = np.array([*places.values()])
    along_m = at @ np.array([np.cos(bearing), np.sin(bearing)])
    heights = dict(
        zip(places, np.sin(along_m * waves_per_m + phase).sum(axis=1).tolist(), strict=True)
    )
    steepest = max(
        _STEEPER
        * abs(heights[one.end] - heights[one.start])
        / float(np.hypot(*np.subtract(places[one.end], places[one.start])))
        for one in streets
    )
    return {name: round(height * grade / steepest, 3) for name, height in heights.items()}


def _node(name: str, at: Place, heights_m: Mapping[str, float], arms: int) -> Row:
    row: Row = {"id": name, "x": round(at[0], 2), "y": round(at[1], 2), "radius": _CORNER_RADIUS_M}
    if heights_m:
        row["z"] = heights_m[name]
    return {**row, "type": "traffic_light", "tl": name} if arms > 2 else row


def _edge(
    street: _Street,
    places: Mapping[str, Place],
    heights_m: Mapping[str, float],
    backwards: bool,
) -> Row:
    start, end = (street.end, street.start) if backwards else (street.start, street.end)
    line: Sequence[tuple[float, ...]] = _line(
        places[street.start], places[street.end], street.bend_m
    )
    if heights_m:
        line = _climbing(line, heights_m[street.start], heights_m[street.end])
    return {
        "id": f"{start}{end}",
        "from": start,
        "to": end,
        "numLanes": street.lanes,
        "speed": SPEED_MPS,
        "width": LANE_WIDTH_M,
        "shape": " ".join(
            ",".join(f"{value:.2f}" for value in point)
            for point in (line[::-1] if backwards else line)
        ),
    }


def _climbing(
    line: Sequence[tuple[float, ...]], start_m: float, end_m: float
) -> list[tuple[float, float, float]]:
    """Returns a street's middle with heights: level at both ends, as junctions are."""
    flat = resample(np.array(line), _CLIMB_STEP_M)
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(flat, axis=0).T))])
    share = along_m / along_m[-1]
    height_m = start_m + (end_m - start_m) * share**2 * (3 - 2 * share)
    return [(x, y, z) for (x, y), z in zip(flat.tolist(), height_m.tolist(), strict=True)]


def _line(start: Place, end: Place, bend_m: float) -> list[Place]:
    """Returns the street's middle, which leaves both places along the straight line."""
    if not bend_m:
        return [start, end]
    along = np.subtract(end, start)
    left = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    share = np.linspace(0, 1, 9)[:, None]
    points = start + share * along + bend_m * np.sin(np.pi * share) ** 2 * left
    return [(x, y) for x, y in points.tolist()]


def _plans(net: Net) -> str:
    """Returns netconvert's file of signal plans."""
    links: list[tuple[str, Row]] = []
    logics = ""
    for tls in net.programs:
        controlled = sorted((c for c in net.connections if c.tls == tls), key=lambda c: c.link)
        links += [
            ("connection", {**_connection(c), "tl": tls, "linkIndex": c.link}) for c in controlled
        ]
        phases = "".join(
            f'<phase duration="{duration_s}" state="{state}"/>'
            for duration_s, state in _split_phases(net, controlled)
        )
        logics += (
            f'<tlLogic id={quoteattr(tls)} type="static" programID="0" offset="0">{phases}'
            "</tlLogic>"
        )
    return xml("tlLogics", links, logics)


def _split_phases(net: Net, controlled: Sequence[NetConnection]) -> list[tuple[int, str]]:
    """Returns durations in s and states: one approach after another, in the order of links."""
    edges = [net.lanes[c.from_lane].edge for c in controlled]
    phases = []
    for approach in dict.fromkeys(edges):
        green = "".join("G" if edge == approach else "r" for edge in edges)
        phases.append((_GREEN_S[len(net.edges[approach])], green))
        phases.append((_YELLOW_S, green.replace("G", "y")))
        phases.append((_ALL_RED_S, "r" * len(edges)))
    return phases


def _connection(connection: NetConnection) -> Row:
    (start, from_lane), (end, to_lane) = (
        lane.rsplit("_", 1) for lane in (connection.from_lane, connection.to_lane)
    )
    return {"from": start, "to": end, "fromLane": from_lane, "toLane": to_lane}
