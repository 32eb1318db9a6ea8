"""Static parts of the picture: road surface, signal heads, places of labels, camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats
from protocol.roadmap import Lane, RoadMap
from studies.outlines import borders, resampled, view_azimuth

HEAD_ABOVE_M = 5.0
COUNT_ABOVE_M = 2.5
COUNT_AT_M = {"upstream": 30.0, "downstream": 22.0}
"""How far from the stop bar, or from where the exit begins, a lane's count stands."""
_BAR_INSET = 0.1  # of the lane's width, on either side
_STEP_M = 5.0
_BACK_M, _UP_M, _AHEAD_M = 60.0, 54.0, 2.0
_BACK_SHARE, _UP_SHARE = 0.4, 1.6  # more for each metre that the junctions lie from their middle


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The road as a mesh: vertices (V, 3) and triangles (T, 3); lines (K, 3) between its lanes."""

    vertices: Floats
    triangles: npt.NDArray[np.uint32]
    markings: list[Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """Where the lanes end at the signal: stop bars (N, 2, 3) and heads above them (N, 3)."""

    lanes: list[str]
    bars: Floats
    places: Floats


@dataclass(frozen=True, slots=True)
class Camera:
    """The initial camera: position and target, in m in the map frame."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]


def surface(road_map: RoadMap) -> Surface:
    """Returns the lanes' surfaces and the lines between them."""
    vertices, triangles, markings, count = [], [], [], 0
    for lane in road_map.lanes:
        left, right = (resampled(side, _STEP_M) for side in borders(lane))
        strip = np.stack([left, right[_nearest(len(right), len(left))]], axis=1)
        vertices.append(strip.reshape(-1, 3))
        triangles.append(count + _strip_triangles(len(strip)))
        count += 2 * len(strip)
        if not lane.internal:
            markings += [left, right]
    return Surface(
        np.concatenate([np.empty((0, 3)), *vertices]),
        np.concatenate([np.empty((0, 3)), *triangles]).astype(np.uint32),
        markings,
    )


def heads(road_map: RoadMap) -> Heads:
    """Returns a stop bar and a signal head for each lane that ends at the signal."""
    lanes = [name for name in road_map.incoming if name in road_map.by_id]
    bars = [_bar(road_map.by_id[name]) for name in lanes]
    stacked = np.array(bars, np.float64).reshape(-1, 2, 3)
    return Heads(lanes, stacked, stacked.mean(axis=1) + _up(HEAD_ABOVE_M))


def count_place(lane: Lane, side: str) -> Floats:
    """Returns where the count of a lane stands (3,): near the junction, and near its middle."""
    points = lane.points[::-1] if side == "upstream" else lane.points
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(lengths_m)])
    at_m = min(COUNT_AT_M[side], along_m[-1] / 2)
    place = [np.interp(at_m, along_m, column) for column in points.T]
    return np.array(place) + _up(COUNT_ABOVE_M)


def count_places(road_map: RoadMap) -> dict[tuple[str, str], Floats]:
    """Returns where the counts of all lanes stand (3,), by the side of the stop bar and lane."""
    return {
        (side, name): count_place(lane, side)
        for side in COUNT_AT_M
        for name, lane in road_map.by_id.items()
    }


def approaches(road_map: RoadMap, lanes: Iterable[str]) -> list[str]:
    """Returns the edges that the lanes belong to, in their order."""
    known = (road_map.by_id[lane].edge for lane in lanes if lane in road_map.by_id)
    return list(dict.fromkeys(known))


def camera(road_map: RoadMap) -> Camera:
    """Returns the initial camera, from above: at one junction so that a T's stem leads away.

    Of several, north is ahead.
    """
    is_one = len(road_map.intersections) == 1
    azimuth_rad = view_azimuth(road_map) if is_one else np.pi / 2
    ahead = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    target = np.array(road_map.centre) + _AHEAD_M * ahead
    centres = np.array([one.centre for one in road_map.intersections])
    spread_m = float(np.linalg.norm(centres - road_map.centre, axis=1).max())
    back_m, up_m = _BACK_M + _BACK_SHARE * spread_m, _UP_M + _UP_SHARE * spread_m
    place = target - back_m * ahead + _up(up_m)
    return Camera(_triple(place), _triple(target))


def _triple(place: Floats) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def _bar(lane: Lane) -> Floats:
    left, right = (side[-1] for side in borders(lane))
    inset = _BAR_INSET * (right - left)
    return np.stack([left + inset, right - inset])


def _nearest(there: int, here: int) -> npt.NDArray[np.int64]:
    """Returns for each of so many points the one of the other border beside it."""
    return np.rint(np.linspace(0, there - 1, here)).astype(np.int64)


def _strip_triangles(pairs: int) -> npt.NDArray[np.int64]:
    """Returns the triangles (2(K-1), 3) of a strip of K pairs, facing up."""
    first = 2 * np.arange(pairs - 1)[:, None]
    return np.concatenate([first + np.array([0, 1, 2]), first + np.array([1, 3, 2])])


def _up(metres: float) -> Floats:
    return np.array([0.0, 0.0, metres])
