"""Parked cars: bodies at the kerb that never move, drawn by the seed.

They stand on the pavement along the road, in spaces of their own: off all lanes, away from
junctions, street lights and each other. The setup holds them, for every process needs them once:
the world's host adds them to the ticks, and evaluations do not count detections of them as ghosts.
The truth, which is about traffic, does not hold them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from protocol.geometry import Floats
from protocol.messages import ObjectClass, VehicleType
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.noise import stream
from sensing.road import Edge, RoadArea, resample
from sensing.scene import street_light_feet
from sensing.terrain import Terrain

SPACE_M = 6.5
"""Along the road, for a car with room to leave; parallel spaces are 6.1 to 7.3 m long."""
_LONGEST_M = 5.5  # of what fits into a space
_GAP_M = (0.15, 0.4)  # from the road's edge to the car's side
_JITTER_M, _JITTER_RAD = 0.3, np.radians(1.5)
_FROM_JUNCTION_M = 12.0  # from its lanes; the law keeps 5 m free (StVO, section 12), and crossings
_FROM_LIGHT_M = 0.4  # from the middle of its pole
_CORNERS = np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5), (0.5, 0.0), (-0.5, 0.0)])
_CLEAR_M = 0.05  # that a corner keeps off the road


@dataclass(frozen=True, slots=True, eq=False)
class ParkedCars:
    """Types (P,) and poses (P, 6) of their footprints' centres, on the ground or the pavement."""

    types: list[str]
    poses: Floats


def draw_parked(
    roads: RoadMap, types: Sequence[VehicleType], per_100m: float, scene: SceneConfig, seed: int
) -> ParkedCars:
    """Returns the cars that are parked along all roads of the map.

    Args:
        roads: the map.
        types: of the traffic; the cars of them that fit into a space park.
        per_100m: of kerb, where parking is possible.
        scene: has the kerbs and the street lights.
        seed: the scenario's; a higher density keeps every car of a lower one.
    """
    kinds = [t for t in types if t.object_class == ObjectClass.CAR and t.length_m <= _LONGEST_M]
    if not kinds or per_100m <= 0:
        return ParkedCars([], np.zeros((0, 6)))
    area = RoadArea(roads)
    edges = area.edges()
    kerb = _Kerb(
        area,
        junctions=_Places(_junction_places(roads)),
        lights=_Places(street_light_feet(edges, area, scene)[:, :2]),
        taken=_Places(np.zeros((0, 2))),
    )
    rng = stream(seed, "parked")
    share = per_100m * SPACE_M / 100
    found: list[tuple[VehicleType, Floats]] = []
    for edge in edges:
        for space in _spaces(edge):
            # Every space draws alike, so that what is near it changes no other.
            occupied, *draws = rng.random(5).tolist()
            car = _car_in(space, kinds, *draws)
            if occupied < share and kerb.has_room_for(car):
                kerb.taken.add(car.place)
                found.append((car.kind, np.array([*car.place, car.yaw, space.level_m])))
    return _standing(found, roads, scene, seed)


@dataclass(frozen=True, slots=True, eq=False)
class _Space:
    """A space along an edge: its middle (2,), the unit vectors (2,) ahead and off the road.

    `level_m` is the height of the lane beside it.
    """

    middle: Floats
    ahead: Floats
    outward: Floats
    level_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Car:
    """A car of a type that may park: the middle of its footprint (2,), and its yaw."""

    kind: VehicleType
    place: Floats
    yaw: float

    @property
    def corners(self) -> Floats:
        """The corners of its footprint and the middles of its ends (6, 2)."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        turned = np.array([[cos, sin], [-sin, cos]])
        sides_m = self.kind.length_m, self.kind.width_m
        return np.asarray(self.place + _CORNERS * sides_m @ turned)


@dataclass(frozen=True, slots=True, eq=False)
class _Kerb:
    """Where cars may park: off the road, away from junctions, lights and parked cars."""

    area: RoadArea
    junctions: _Places
    lights: _Places
    taken: _Places

    def has_room_for(self, car: _Car) -> bool:
        """Whether a car may park in its place."""
        corners = car.corners
        return bool(
            self.junctions.distance_m(car.place) >= _FROM_JUNCTION_M
            and self.area.clearance_m(corners, 1.0).min() >= _CLEAR_M
            and self.taken.distance_m(car.place) >= SPACE_M - 2 * _JITTER_M
            and self.lights.distance_m(corners) >= _FROM_LIGHT_M + car.kind.width_m / 2
        )


def _car_in(
    space: _Space,
    kinds: Sequence[VehicleType],
    kind_at: float,
    gap: float,
    shift: float,
    turn: float,
) -> _Car:
    """Returns the car that four uniform draws from 0 to 1 put into a space."""
    kind = kinds[int(kind_at * len(kinds))]
    aside_m = _GAP_M[0] + gap * (_GAP_M[1] - _GAP_M[0]) + kind.width_m / 2
    place = space.middle + space.outward * aside_m + space.ahead * (2 * shift - 1) * _JITTER_M
    yaw = np.arctan2(space.ahead[1], space.ahead[0]) + (2 * turn - 1) * _JITTER_RAD
    return _Car(kind, place, float(yaw))


def _spaces(edge: Edge) -> Iterator[_Space]:
    """Yields the spaces along an edge."""
    length_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(edge.points, axis=0).T))])
    for start_m, end_m in pairwise(np.arange(0.0, length_m[-1], SPACE_M)):
        ends = [
            np.array([np.interp(at_m, length_m, edge.points[:, axis]) for axis in (0, 1)])
            for at_m in (start_m, end_m)
        ]
        ahead = ends[1] - ends[0]
        ahead /= np.hypot(*ahead)
        right = np.array([ahead[1], -ahead[0]])
        middle = int(np.searchsorted(length_m, (start_m + end_m) / 2))
        outward = right if right @ edge.outward[middle] > 0 else -right
        yield _Space((ends[0] + ends[1]) / 2, ahead, outward, float(edge.level_m[middle]))


def _junction_places(roads: RoadMap) -> Floats:
    """Returns places (N, 2) on the lanes inside junctions, their outlines and the stop bars."""
    parts = [resample(lane.points[:, :2], 2.0) for lane in roads.lanes if lane.internal]
    parts += [resample(np.array(one.outline), 2.0) for one in roads.intersections if one.outline]
    bars = [roads.by_id[name].points[-1, :2] for name in roads.incoming if name in roads.by_id]
    return np.concatenate([np.zeros((0, 2)), *parts, np.array(bars).reshape(-1, 2)])


_PLOT_M = 16.0


class _Places:
    """Places in the plane, by square plots, so that the nearest of a city's is found at once.

    Distances beyond a plot's side are only lower bounds.
    """

    def __init__(self, places: Floats) -> None:
        self._plots: dict[tuple[int, int], list[Floats]] = {}
        for place in places:
            self.add(place)

    def add(self, place: Floats) -> None:
        """Keeps a place (2,)."""
        column, row = (int(n) for n in np.floor(place / _PLOT_M))
        self._plots.setdefault((column, row), []).append(place)

    def distance_m(self, at: Floats) -> float:
        """Returns the least distance from places (2,) or (N, 2) to those that are kept."""
        spots = np.atleast_2d(at)
        column, row = (int(n) for n in np.floor(spots.mean(axis=0) / _PLOT_M))
        near = [
            place
            for i in (column - 1, column, column + 1)
            for j in (row - 1, row, row + 1)
            for place in self._plots.get((i, j), ())
        ]
        if not near:
            return _PLOT_M
        return float(np.linalg.norm(spots[:, None] - np.array(near), axis=2).min())


def _standing(
    found: list[tuple[VehicleType, Floats]], roads: RoadMap, scene: SceneConfig, seed: int
) -> ParkedCars:
    """Returns the cars with all four wheels on the pavement, as high as its kerb."""
    plane = np.array([place for _, place in found]).reshape(-1, 4)
    poses = Terrain(roads, scene, seed).body_poses(*plane.T)
    poses[:, 2] += scene.kerb_height_m
    return ParkedCars([kind.name for kind, _ in found], poses)
