"""Distances from the road, found by way of an index."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.geometry import Floats
from protocol.roadmap import Intersection, RoadMap
from sensing.mesh import contains
from sensing.road import RoadArea
from tests.roads import CENTRE, lane, one_junction, signal

SPACING_M = 200.0


@pytest.fixture(scope="module")
def district() -> RoadMap:
    """Three streets either way, a long diagonal, a bend of short pieces, and nine junctions."""
    ways = [-SPACING_M, 0.0, SPACING_M]
    lanes = [lane(f"h{k}_0", [(-400, y, 0), (400, y, 0)]) for k, y in enumerate(ways)]
    lanes += [lane(f"v{k}_0", [(x, -400, 0), (x, 400, 0)]) for k, x in enumerate(ways)]
    angle = np.linspace(0, 3, 40)
    bend = [(50 * float(np.cos(a)), 150 + 20 * float(np.sin(a)), 0.0) for a in angle]
    lanes += [lane("diagonal_0", [(-390, -370, 0), (380, 390, 0)], width_m=9.0), lane("b_0", bend)]
    ring = np.array([[-12.0, -9.0], [11.0, -10.0], [12.5, 9.0], [0.0, 2.0], [-10.0, 11.0]])
    outlines = [ring + np.array([x, y]) for x in ways for y in ways]
    intersections = [
        Intersection(signal=signal(f"j{k}"), centre=CENTRE, outline=outline.tolist())
        for k, outline in enumerate(outlines)
    ]
    return RoadMap(name="district", lanes=lanes, intersections=intersections)


def by_all_lanes(xy: Floats, road_map: RoadMap) -> Floats:
    """Returns the clearances (N,) without an index."""
    nearest = np.full(len(xy), np.inf)
    for one in road_map.lanes:
        for (ax, ay), (bx, by) in zip(one.points[:-1, :2], one.points[1:, :2], strict=True):
            ux, uy = bx - ax, by - ay
            x, y = xy[:, 0] - ax, xy[:, 1] - ay
            share = np.clip((x * ux + y * uy) / (ux * ux + uy * uy), 0.0, 1.0)
            dx, dy = x - share * ux, y - share * uy
            nearest = np.minimum(nearest, np.sqrt(dx * dx + dy * dy) - one.width_m / 2)
    for intersection in road_map.intersections:
        nearest = np.where(
            contains(np.array(intersection.outline), xy), np.minimum(nearest, 0.0), nearest
        )
    return nearest


def places(reach_m: float) -> Floats:
    return np.random.default_rng(5).uniform(-reach_m, reach_m, (4000, 2))


@pytest.mark.parametrize("reach_m", [30.0, 420.0, 3000.0, 1e7])
def test_the_index_finds_the_very_distances_of_a_full_search(
    district: RoadMap, reach_m: float
) -> None:
    xy = places(reach_m)
    assert np.array_equal(RoadArea(district).clearance_m(xy), by_all_lanes(xy, district))


def test_inside_any_junction_is_on_the_road(district: RoadMap) -> None:
    corners = np.array([[x - 9.0, y + 9.0] for x in (-200, 0, 200) for y in (-200, 0, 200)])
    assert (RoadArea(district).clearance_m(corners) <= 0).all()


def test_every_junction_has_a_border(district: RoadMap) -> None:
    middles = np.array([edge.points.mean(axis=0) for edge in RoadArea(district).edges()])
    for x in (-200, 0, 200):
        for y in (-200, 0, 200):
            assert np.hypot(*(middles - (x, y)).T).min() < 12


def test_a_search_may_end_early_beyond_a_distance(district: RoadMap) -> None:
    area, xy = RoadArea(district), places(600.0)
    exact, early = area.clearance_m(xy), area.clearance_m(xy, 50.0)
    assert np.array_equal(exact[exact <= 50], early[exact <= 50])
    assert (early[exact > 50] > 50).all()


def test_a_map_of_distant_roads_has_a_small_index() -> None:
    far = [lane("a_0", [(0, 0, 0), (50, 0, 0)]), lane("b_0", [(9e5, 9e5, 0), (9e5, 9.1e5, 0)])]
    road_map = one_junction("far", far, signal("t"), junction=[(0, 0), (9, 0), (0, 9)])
    xy = np.array([[25.0, 10.0], [9e5, 9.05e5], [4e5, 4e5]])
    assert np.array_equal(RoadArea(road_map).clearance_m(xy), by_all_lanes(xy, road_map))
