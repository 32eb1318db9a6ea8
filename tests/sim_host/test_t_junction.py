"""The built-in junction has the facts of Chen et al. 2022."""

from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.messages import Setup
from protocol.roadmap import RoadMap
from sim_host.compatible_phases import compatible_phases
from sim_host.setup import with_greens


@pytest.fixture
def roads(setup: Setup) -> RoadMap:
    return setup.road_map


def test_lanes_and_lengths_are_those_of_the_paper(roads: RoadMap) -> None:
    lengths = {"west_in": (4, 193), "east_in": (4, 237), "north_in": (2, 431)}
    for edge, (count, length_m) in lengths.items():
        lanes = [lane for lane in roads.lanes if lane.edge == edge]
        assert len(lanes) == count
        for lane in lanes:
            assert lane.length_m == pytest.approx(length_m, abs=1)
            assert lane.speed_mps == 13.89
            assert lane.width_m == 3.5
    assert not [lane for lane in roads.lanes if lane.edge == "north_out"]


def test_the_side_road_turns_left_into_all_lanes_and_right_into_one(roads: RoadMap) -> None:
    links = [(link.from_lane, link.to_lane) for link in roads.intersections[0].signal.links]
    assert links[:5] == [
        ("north_in_0", "west_out_0"),
        *(("north_in_1", f"east_out_{i}") for i in range(4)),
    ]
    assert links[5:9] == [(f"east_in_{i}", f"west_out_{i}") for i in range(4)]
    assert links[9:] == [(f"west_in_{i}", f"east_out_{i}") for i in range(4)]


def test_two_phases_main_and_side(roads: RoadMap) -> None:
    assert roads.intersections[0].signal.greens == ["rrrrrGGGGGGGG", "GGGGGrrrrrrrr"]


def test_the_right_turn_may_go_with_the_road_that_it_does_not_cross(roads: RoadMap) -> None:
    assert compatible_phases(roads.intersections[0].signal, roads) == ["GrrrrrrrrGGGG"]


def test_conflicts_are_those_of_the_two_roads(roads: RoadMap) -> None:
    # The right turn meets the lanes from the east alone; the left turns meet both directions.
    assert set(roads.intersections[0].signal.conflicts) == {(0, m) for m in range(5, 9)} | {
        (s, m) for s in range(1, 5) for m in range(5, 13)
    }


def test_lanes_follow_one_another_through_the_junction(roads: RoadMap) -> None:
    for link in roads.intersections[0].signal.links:
        inside = roads.by_id[link.from_lane].successors
        assert all(roads.by_id[lane].internal for lane in inside)
        assert [link.to_lane] in [roads.by_id[lane].successors for lane in inside]


def test_the_centre_is_the_origin_and_lies_inside_the_outline(roads: RoadMap) -> None:
    assert roads.centre == (0, 0, 0)
    xs, ys = zip(*roads.intersections[0].outline, strict=True)
    assert min(xs) < 0 < max(xs)
    assert min(ys) < 0 < max(ys)


def test_the_main_road_climbs_to_the_east(roads: RoadMap) -> None:
    assert roads.by_id["east_in_0"].centreline[0][2] == 2.0
    assert roads.by_id["east_in_0"].centreline[-1][2] == 0.0


def test_the_demand_is_the_papers(run_dir: Path, setup: Setup) -> None:
    assert setup.road_map.name == "t_junction"
    text = (run_dir / "sumo" / "demand.rou.xml").read_text()
    assert text.count(f"exp({4 * 500 / 3600:.9f})") == 2  # both main approaches
    assert text.count(f"exp({360 / 3600:.9f})") == 2  # both turns of the side road
    assert 'edges="north_in west_out"' in text


def test_the_fixed_plan_takes_other_greens_and_keeps_its_changes(roads: RoadMap) -> None:
    (tls,) = roads.by_tls  # which keeps what it has found
    plan = with_greens(roads, [12, 9]).by_tls[tls].signal.plan
    assert [phase.duration_s for phase in plan] == [12, 4, 1, 9, 4, 1]
    assert [phase.state for phase in plan] == [
        phase.state for phase in roads.intersections[0].signal.plan
    ]
    assert with_greens(roads, []) is roads


def test_another_number_of_greens_than_the_plan_has_is_refused(roads: RoadMap) -> None:
    with pytest.raises(ConfigError, match="plan_greens_s: 3 durations, the plan of .* has 2"):
        with_greens(roads, [10, 10, 10])
