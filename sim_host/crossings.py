"""Pedestrian crossings over the arms of a junction, and their conflicts with vehicles.

A net need not have crossings of its own. Each arm gets one, just inside the stop bars, from kerb to
kerb. Where a path through the junction passes over it, vehicles and people are in conflict. Each
carriageway is a zone on which nobody may stop; between them people can stand.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from protocol.approaches import InnerPath, through_junction
from protocol.geometry import Floats
from protocol.roadmap import Intersection, Lane, RoadMap
from sensing.road import RoadArea, resample

INSIDE_M = 2.0  # from the stop bars to a crossing's middle
HALF_WIDTH_M = 0.8
_HALF_VEHICLE_M = 1.4  # half a lorry, and a little
_LEAST_STAND_M = 0.6  # between two carriageways, for someone to stand there
_SAMPLE_M = 0.1
_FARTHEST_M = 60.0  # before the stop bar, within which vehicles are considered
_BEYOND_M = 15.0  # of the lane behind the junction
_ONE_ARM_M, _ONE_ARM_DEG = 30.0, 50.0
_TURN_DEG = 45.0
_KERB_M = 0.5  # off the road, where people wait
_LONGEST_M = 40.0


@dataclass(frozen=True, slots=True)
class Conflict:
    """A path of vehicles over a crossing.

    Attributes:
        link: of the signal that lets them in.
        is_own: whether they come from the crossing's own arm.
        is_turning: whether they turn, and so have to let people pass.
        begin_m, end_m: along the crossing, from its start: where they pass.
        enter_m, leave_m: behind the stop bar along their path: where they are on the crossing.
        lanes: with each one's start behind the stop bar (negative before it), m along the path, and
            what to multiply SUMO's positions on it with.
    """

    link: int
    is_own: bool
    is_turning: bool
    begin_m: float
    end_m: float
    enter_m: float
    leave_m: float
    lanes: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, slots=True)
class Zone:
    """A stretch of a crossing on which nobody may stop."""

    begin_m: float
    end_m: float
    conflicts: tuple[Conflict, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """The crossing of an arm, from the kerb at one side to that at the other.

    Attributes:
        tls: the signal.
        ends: x, y of both (2, 2), off the road.
        outward: unit vector (2,) along the arm, away from the junction.
        kerbs: the road's border along the arm from each end outwards, two of (K, 2); and
        aside: unit vectors (K, 2) away from the road there, two as well.
        zones: in order from the start.
    """

    tls: str
    ends: Floats
    outward: Floats
    kerbs: tuple[Floats, Floats]
    aside: tuple[Floats, Floats]
    zones: tuple[Zone, ...]

    @property
    def length_m(self) -> float:
        """From end to end."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))


def crossings_of(roads: RoadMap) -> list[Crossing]:
    """Returns the crossings of all junctions of the map, by signal and bearing."""
    area = RoadArea(roads)
    return [
        crossing
        for one in roads.intersections
        for arm in _arms(roads, one)
        if (crossing := _crossing(roads, one, arm, area)) is not None
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Arm:
    """Lanes to and from a junction, whose lines run outwards from it."""

    lanes: list[Lane]
    lines: list[Floats]
    outward: Floats
    incoming: set[str]

    @property
    def foot(self) -> Floats:
        """The middle of where its lanes end (2,)."""
        return np.asarray(np.mean([line[0] for line in self.lines], axis=0))


def _arms(roads: RoadMap, one: Intersection) -> list[_Arm]:
    """Returns the arms: what leads in and what leads out side by side is one."""
    ways_in = _edges(roads, one.incoming)
    ways_out = _edges(roads, one.outgoing)
    arms = []
    for lanes in ways_in:
        arm = _arm(lanes, [])
        beside = [way for way in ways_out if _is_beside(arm, _arm([], way))]
        if beside:
            nearest = min(beside, key=lambda way: float(np.hypot(*(_arm([], way).foot - arm.foot))))
            ways_out.remove(nearest)
            arm = _arm(lanes, nearest)
        arms.append(arm)
    arms += [_arm([], lanes) for lanes in ways_out]
    return sorted(arms, key=lambda arm: float(np.arctan2(arm.outward[1], arm.outward[0])))


def _edges(roads: RoadMap, names: Iterable[str]) -> list[list[Lane]]:
    found: dict[str, list[Lane]] = {}
    for name in names:
        if name in roads.by_id:
            found.setdefault(roads.by_id[name].edge, []).append(roads.by_id[name])
    return list(found.values())


def _arm(ways_in: Sequence[Lane], ways_out: Sequence[Lane]) -> _Arm:
    lines = [lane.points[::-1, :2] for lane in ways_in] + [lane.points[:, :2] for lane in ways_out]
    ahead = np.sum([(line[1] - line[0]) / np.hypot(*(line[1] - line[0])) for line in lines], axis=0)
    return _Arm(
        [*ways_in, *ways_out], lines, ahead / np.hypot(*ahead), {lane.id for lane in ways_in}
    )


def _is_beside(a: _Arm, b: _Arm) -> bool:
    is_near = np.hypot(*(a.foot - b.foot)) < _ONE_ARM_M
    return bool(is_near and a.outward @ b.outward > np.cos(np.radians(_ONE_ARM_DEG)))


def _crossing(roads: RoadMap, one: Intersection, arm: _Arm, area: RoadArea) -> Crossing | None:
    """Returns an arm's crossing; None if there is no kerb within reach."""
    left = np.array([-arm.outward[1], arm.outward[0]])
    at_m = min(float(line[0] @ arm.outward) for line in arm.lines) - INSIDE_M
    sides = [(float(line[0] @ left), n) for n, line in enumerate(arm.lines)]
    (low_m, low), (high_m, high) = min(sides), max(sides)
    ends = []
    for start_m, sign in ((low_m - arm.lanes[low].width_m / 2, -1.0),
                          (high_m + arm.lanes[high].width_m / 2, 1.0)):  # fmt: skip
        way_m = start_m + sign * np.arange(0.0, _LONGEST_M / 2, _SAMPLE_M)
        places = arm.outward * at_m + way_m[:, None] * left
        free = np.flatnonzero(area.clearance_m(places, 2.0) >= _KERB_M)
        if not len(free):
            return None
        ends.append(places[free[0]])
    crossing = np.array(ends)
    length_m = float(np.hypot(*(crossing[1] - crossing[0])))
    if length_m > _LONGEST_M:
        return None
    kerbs = [_kerb(arm, low, -1.0), _kerb(arm, high, 1.0)]
    return Crossing(
        tls=one.tls,
        ends=crossing,
        outward=arm.outward,
        kerbs=(kerbs[0][0], kerbs[1][0]),
        aside=(kerbs[0][1], kerbs[1][1]),
        zones=_zones(_conflicts(roads, one, arm, crossing), length_m),
    )


def _kerb(arm: _Arm, lane: int, sign: float) -> tuple[Floats, Floats]:
    """Returns the border (K, 2) of an arm's outermost lane, and what is off the road (K, 2)."""
    line = resample(arm.lines[lane], 2.0)
    ahead = np.gradient(line, axis=0)
    ahead /= np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    aside = sign * np.column_stack([-ahead[:, 1], ahead[:, 0]])
    return line + aside * arm.lanes[lane].width_m / 2, aside


def _conflicts(roads: RoadMap, one: Intersection, arm: _Arm, ends: Floats) -> list[Conflict]:
    samples = resample(ends, _SAMPLE_M)
    along_m = np.hypot(*(samples - ends[0]).T)
    links = {(link.from_lane, link.to_lane): link.index for link in one.signal.links}
    found = []
    for path, start in _ways(roads, one):
        line, way_m = _line(roads, path)
        apart_m = np.linalg.norm(samples[:, None] - line, axis=2)
        blocked = apart_m.min(axis=1) < _HALF_VEHICLE_M
        if not blocked.any():
            continue
        met = way_m[apart_m[blocked].min(axis=0) < HALF_WIDTH_M + 0.3]
        if not len(met):
            continue
        found.append(
            Conflict(
                link=links[start, path.exit],
                is_own=start in arm.incoming,
                is_turning=_turns(roads, start, path.exit),
                begin_m=float(along_m[blocked].min()),
                end_m=float(along_m[blocked].max()),
                enter_m=float(met.min()),
                leave_m=float(met.max()),
                lanes=_lanes(roads, path, start),
            )
        )
    return found


def _turns(roads: RoadMap, start: str, end: str) -> bool:
    before, after = roads.by_id[start].points[-2:, :2], roads.by_id[end].points[:2, :2]
    one, other = before[1] - before[0], after[1] - after[0]
    straight = one @ other / (np.hypot(*one) * np.hypot(*other))
    return bool(straight < np.cos(np.radians(_TURN_DEG)))


def _ways(roads: RoadMap, one: Intersection) -> list[tuple[InnerPath, str]]:
    """Returns the paths through a junction, and the lane from which each begins."""
    starts = {
        after: lane for lane in one.incoming if lane in roads.by_id
        for after in roads.by_id[lane].successors
    }  # fmt: skip
    return [(path, starts[path.inner[0][0]]) for path in through_junction(roads, one)]


def _line(roads: RoadMap, path: InnerPath) -> tuple[Floats, Floats]:
    """Returns places (K, 2) on a path and how far behind the stop bar each is (K,)."""
    parts = [roads.by_id[name].points[:, :2] for name, _ in path.inner]
    line = resample(np.concatenate([*parts, roads.by_id[path.exit].points[:, :2]]), 0.5)
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    kept = way_m <= path.way_m + _BEYOND_M
    return line[kept], way_m[kept]


def _lanes(roads: RoadMap, path: InnerPath, start: str) -> tuple[tuple[str, float, float], ...]:
    """Returns the lanes of `Conflict`: from 60 m before the stop bar to behind the junction."""
    found = [(name, way_m, roads.by_id[name].measured_share) for name, way_m in path.inner]
    found.append((path.exit, path.way_m, roads.by_id[path.exit].measured_share))
    todo, seen = [(start, 0.0)], {start}
    while todo:
        name, end_m = todo.pop()
        lane = roads.by_id[name]
        found.append((name, end_m - lane.measured_m, lane.measured_share))
        if lane.measured_m - end_m < _FARTHEST_M:
            before = [one for one in roads.predecessors[name] if one not in seen]
            todo += [(one, end_m - lane.measured_m) for one in before]
            seen.update(before)
    return tuple(found)


def _zones(conflicts: list[Conflict], length_m: float) -> tuple[Zone, ...]:
    """Returns a zone for each carriageway, one for both where they meet.

    People stand in the middle of the gap between them.
    """
    groups = [[c for c in conflicts if c.is_own], [c for c in conflicts if not c.is_own]]
    spans = sorted(
        (min(c.begin_m for c in group), max(c.end_m for c in group), n)
        for n, group in enumerate(groups)
        if group
    )
    if not spans:
        return ()
    if len(spans) == 1 or spans[1][0] - spans[0][1] < _LEAST_STAND_M:
        return (Zone(0.0, length_m, tuple(conflicts)),)
    middle_m = (spans[0][1] + spans[1][0]) / 2
    first, second = (tuple(groups[n]) for _, _, n in spans)
    return Zone(0.0, middle_m, first), Zone(middle_m, length_m, second)
