"""Lanes, distances and counts."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.lanes import LaneIndex, LanePositions
from perception.object_classes import passenger_car_units
from protocol.roadmap import RoadMap
from tests.roads import junction_road, lane, one_junction, signal


def locate(
    index: LaneIndex, *vehicles: tuple[float, float, float], margin_m: float = 0.5
) -> LanePositions:
    boxes = np.array([(x, y, 0.75, 4.5, 1.8, 1.5, yaw) for x, y, yaw in vehicles])
    return index.locate(boxes.reshape(-1, 7), margin_m=np.full(len(boxes), margin_m))


@pytest.mark.parametrize(
    ("x", "y", "yaw", "lane", "distance_m"),
    [
        (-30, -1.5, 0, "in_0", 20),
        (-30, 2.0, 0, "in_1", 20),
        (-200, 0.5, 0, "far_0", 190),
        (0, 1.75, 0, ":j_1", -10),
        (50, -1.75, 0, "out_0", -52.816),
        (170, -1.75, 0, "gone_0", -172.816),
        (1.75, -40, np.pi / 2, "side_0", 30),
        (0, 40, 0, "", 0),
    ],
)
def test_a_vehicle_knows_its_lane_and_the_way_to_the_stop_bar(
    road_map: RoadMap, x: float, y: float, yaw: float, lane: str, distance_m: float
) -> None:
    index = LaneIndex(road_map)
    place = locate(index, (x, y, yaw))
    assert index.names(place) == [lane]
    # The exit is reached by the shorter of two ways through the junction.
    assert index.distances_m(place)[0] == pytest.approx(distance_m, abs=0.01)


def test_inside_the_junction_the_vehicles_own_direction_decides(road_map: RoadMap) -> None:
    index = LaneIndex(road_map)
    place = locate(index, (2.8, -3.5, np.pi / 3), (2.8, -3.5, 0.0))
    assert index.names(place) == [":j_2", ":j_0"]


def test_counts_end_at_the_reach_and_nobody_counts_twice(road_map: RoadMap) -> None:
    index = LaneIndex(road_map)
    vehicles = [(-30, -1.75, 0), (-200, 0, 0), (-250, 0, 0), (-50, 1.75, 0), (-90, 1.75, 0)]
    vehicles += [(0, 1.75, 0), (50, -1.75, 0), (150, -1.75, 0), (1.75, -40, np.pi / 2)]
    before, behind = index.count(
        locate(index, *vehicles), "j", upstream_m=200.0, downstream_m=100.0
    )
    assert before == {"in_0": 2, "in_1": 2, "side_0": 1}
    assert behind == {"out_0": 1, "out_1": 1}


def test_weights_add_up_where_vehicles_count(road_map: RoadMap) -> None:
    index = LaneIndex(road_map)
    place = locate(index, (-30, -1.75, 0), (-40, -1.75, 0), (50, -1.75, 0), (-900, 0, 0))
    units = passenger_car_units(np.array([1, 0, 2, 1], np.uint8))
    before, behind = index.weigh(place, units, "j", upstream_m=200.0, downstream_m=100.0)
    assert before == {"in_0": 3.0, "in_1": 0.0, "side_0": 0.0}
    assert behind == {"out_0": 0.4, "out_1": 0.0}


def test_no_vehicles_still_name_every_lane(road_map: RoadMap) -> None:
    index = LaneIndex(road_map)
    before, behind = index.count(locate(index), "j", upstream_m=200.0, downstream_m=100.0)
    assert before == {"in_0": 0, "in_1": 0, "side_0": 0}
    assert behind == {"out_0": 0, "out_1": 0}


def test_a_net_without_the_lanes_inside_the_junction_counts_too(road_map: RoadMap) -> None:
    direct = {"in_0": ["out_0"], "in_1": ["out_1"], "side_0": ["out_0"]}
    lanes = [
        lane.model_copy(update={"successors": direct.get(lane.id, lane.successors)})
        for lane in road_map.lanes
        if not lane.internal
    ]
    parts = road_map.model_dump() | {"lanes": [lane.model_dump() for lane in lanes]}
    index = LaneIndex(RoadMap.model_validate(parts))
    place = locate(index, (-30, -1.75, 0), (50, -1.75, 0))
    np.testing.assert_allclose(index.distances_m(place), [20, -40])
    before, behind = index.count(place, "j", upstream_m=200.0, downstream_m=100.0)
    assert (before["in_0"], behind["out_0"]) == (1, 1)


@pytest.mark.parametrize(("y", "name"), [(2.2, "far_0"), (2.3, "")])
def test_a_vehicle_is_on_the_road_as_far_as_its_margin_beyond_the_edge(
    road_map: RoadMap, y: float, name: str
) -> None:
    index = LaneIndex(road_map)
    assert index.names(locate(index, (-200, y, 0), margin_m=0.5)) == [name]


def test_a_vehicle_as_far_away_as_the_limit_counts_and_one_farther_does_not(
    road_map: RoadMap,
) -> None:
    index = LaneIndex(road_map)
    place = locate(index, (-110, -1.75, 0), (60, 1.75, 0))  # 100 m before, 70 m behind
    before, behind = index.count(place, "j", upstream_m=100.0, downstream_m=70.0)
    assert (before["in_0"], behind["out_1"]) == (1, 1)
    before, behind = index.count(place, "j", upstream_m=99.9, downstream_m=69.9)
    assert (before["in_0"], behind["out_1"]) == (0, 0)


def test_none_behind_counts_where_nothing_is_to_count_there(road_map: RoadMap) -> None:
    index = LaneIndex(road_map)
    place = locate(index, (-20, -1.75, 0), (30, 1.75, 0))
    before, behind = index.count(place, "j", upstream_m=100.0, downstream_m=0.0)
    assert (before["in_0"], set(behind.values())) == (1, {0})


def test_every_vehicle_behind_the_stop_bar_counts(road_map: RoadMap) -> None:
    index = LaneIndex(road_map)
    place = locate(index, (30, 1.75, 0), (40, 1.75, 0), (50, 1.75, 0))
    _, behind = index.count(place, "j", upstream_m=200.0, downstream_m=100.0)
    assert behind == {"out_0": 0, "out_1": 3}


def test_distances_are_level_on_a_steep_road() -> None:
    index = LaneIndex(junction_road(climb=0.75))
    boxes = np.array([(-30, -1.75, -22.5, 4.5, 1.8, 1.5, 0), (60, 1.75, 45, 4.5, 1.8, 1.5, 0)])
    place = index.locate(boxes, margin_m=np.full(2, 0.5))
    np.testing.assert_allclose(index.distances_m(place), [20, -70])


def test_lanes_inside_the_junction_lead_on_one_by_one_to_the_exit_of_their_link() -> None:
    road = one_junction(
        name="two inner lanes in a row",
        centre=(0, 0, 0),
        lanes=[
            lane("in", [(-100, 0, 0), (0, 0, 0)], ":a", ":x"),
            lane(":a", [(0, 0, 0), (10, 0, 0)], ":b"),
            lane(":b", [(10, 0, 0), (20, 0, 0)], "out"),
            lane(":x", [(0, 0, 0), (0, 12, 0)], "side"),
            lane("out", [(20, 0, 0), (120, 0, 0)]),
            lane("side", [(0, 12, 0), (0, 112, 0)], "out"),
        ],
        signal=signal("j", ("in", "out"), ("in", "side")),
        junction=[],
    )
    index = LaneIndex(road)
    north = np.pi / 2
    place = locate(index, (5, 0, 0), (15, 0, 0), (0, 8, north), (0, 50, north))
    assert index.names(place) == [":a", ":b", ":x", "side"]
    assert index.distances_m(place).tolist() == [-5, -15, -8, -50]
    _, behind = index.count(place, "j", upstream_m=200.0, downstream_m=100.0)
    assert behind == {"out": 2, "side": 2}


def test_chosen_positions_keep_lane_and_place() -> None:
    index = LaneIndex(junction_road())
    place = locate(index, (-30, -1.5, 0), (0, 40, 0), (-20, 2.0, 0))
    chosen = place.take(np.array([False, True, True]))
    assert index.names(chosen) == ["", "in_1"]
    assert chosen.along_m.tolist() == place.along_m[1:].tolist()


def test_a_road_that_leads_around_into_the_junction_again_belongs_to_its_exit() -> None:
    road = one_junction(
        name="around",
        centre=(0, 0, 0),
        lanes=[
            lane("in", [(-100, 0, 0), (0, 0, 0)], ":a"),
            lane(":a", [(0, 0, 0), (10, 0, 0)], "out"),
            lane("out", [(10, 0, 0), (10, 50, 0)], "back"),
            lane("back", [(10, 50, 0), (-100, 0, 0)], "in"),
        ],
        signal=signal("j", ("in", "out")),
        junction=[],
    )
    index = LaneIndex(road)
    assert index.approaches["j"].upstream.keys() == {"in", "back"}
    assert index.approaches["j"].downstream.keys() == {":a", "out", "back"}
    assert index.approaches["j"].downstream["back"].start_m == -60


def test_lengths_are_level_where_a_lane_climbs_in_part() -> None:
    road = one_junction(
        name="climb",
        centre=(0, 0, 0),
        lanes=[
            lane("in", [(-100, 0, 0), (-60, 0, 30), (0, 0, 30)], "out", length_m=100),
            lane("out", [(0, 0, 30), (100, 0, 30)]),
        ],
        signal=signal("j", ("in", "out")),
        junction=[],
    )
    index = LaneIndex(road)
    box = np.array([(-20, 0, 30.75, 4.5, 1.8, 1.5, 0)])
    place = index.locate(box, margin_m=np.full(1, 0.5))
    np.testing.assert_allclose(index.distances_m(place), [20])


@pytest.mark.parametrize("height_m", [1.5, 4.0])
def test_who_drives_under_an_elevated_road_is_not_on_it(height_m: float) -> None:
    road = one_junction(
        name="deck",
        centre=(0, 0, 0),
        lanes=[
            lane("in", [(-100, 0, 0), (0, 0, 0)], "out"),
            lane("out", [(0, 0, 0), (100, 0, 0)]),
            lane("deck", [(-100, 1.5, 5.5), (100, 1.5, 5.5)]),
        ],
        signal=signal("j", ("in", "out")),
        junction=[],
    )
    index = LaneIndex(road)
    boxes = np.array([(-30, y, height_m / 2, 12, 2.5, height_m, 0) for y in (0, 0.8, 1.3)])
    assert index.names(index.locate(boxes, margin_m=np.full(3, 0.5))) == ["in"] * 3
    above = boxes + np.array([0, 0, 5.5, 0, 0, 0, 0])
    assert index.names(index.locate(above, margin_m=np.full(3, 0.5))) == ["deck"] * 3
