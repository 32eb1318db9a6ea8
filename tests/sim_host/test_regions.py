"""Junctions and regions of a scenario: cut, checked, and found again in every process."""

from pathlib import Path
from typing import Any

import pytest

from protocol.approaches import Approaches
from protocol.errors import ConfigError
from protocol.instances import instances_of, mounts_in, parse_id, region_of
from protocol.regions import regions_of
from protocol.roadmap import RoadMap
from sim_host.netfile import read_net
from sim_host.networks import write_grid
from sim_host.regions import resolve_regions
from sim_host.road_map import road_map
from sim_host.setup import build_setup, resolved

EDGE = {"downstream_m": 100.0, "coverage_range_m": 100.0}


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> RoadMap:
    return road_map(read_net(write_grid(tmp_path_factory.mktemp("grid"))), "all")


@pytest.mark.parametrize("regions", [1, 2, 4, 7, 16])
def test_a_cut_has_as_many_balanced_parts_as_asked(grid: RoadMap, regions: int) -> None:
    found = resolve_regions(grid, regions)
    assert list(found) == [f"r{n}" for n in range(regions)]
    assert sorted(tls for part in found.values() for tls in part) == sorted(grid.by_tls)
    sizes = [len(part) for part in found.values()]
    assert max(sizes) <= 16 / regions + 2
    assert found == resolve_regions(grid, regions)


def test_every_lane_belongs_to_one_intersection_and_approaches_do_not_overlap(
    grid: RoadMap,
) -> None:
    assert {lane.tls for lane in grid.lanes} == set(grid.by_tls)
    seen: set[str] = set()
    for one in grid.intersections:
        upstream = Approaches(grid, one).upstream.keys()
        assert all(grid.by_id[lane].tls == one.tls for lane in upstream)
        assert not upstream & seen
        seen |= upstream


def test_a_region_knows_its_lanes_those_that_count_for_it_and_what_lies_around(
    grid: RoadMap,
) -> None:
    regions = {"a": ["A0"], "rest": sorted(set(grid.by_tls) - {"A0"})}
    maps = regions_of(grid, {"regions": regions, "edge": EDGE})
    own, around = maps["a"].area.by_id.keys(), maps["a"].surroundings.by_id.keys()
    assert {lane.id for lane in grid.lanes if lane.tls == "A0"} < own < around
    assert set(grid.by_tls["A0"].outgoing) <= own
    assert len(around) < len(grid.lanes)
    assert list(maps["a"].area.by_tls) == ["A0"]


@pytest.mark.parametrize(
    ("wanted", "error_text"),
    [
        (17, "regions is 17, but there are 16 junctions: 1 regions would have none"),
        ({"a": []}, r"regions\.a has no junction"),
        ({"a": ["A0"], "b": ["A0"]}, "'A0' stands in a and b, must be in one"),
        ({"a": ["A00"]}, "'A00' is none of the controlled junctions; did you mean A0"),
        ({"a": ["A0"]}, "A1, A2, A3, B0, B1 in no region"),
    ],
)
def test_regions_that_cannot_be_are_refused(grid: RoadMap, wanted: Any, error_text: str) -> None:
    with pytest.raises(ConfigError, match=error_text):
        resolve_regions(grid, wanted)


def test_an_unknown_signal_is_refused_with_those_of_like_names(tmp_path: Path) -> None:
    scenario = {"traffic": {"network": "corridor"}, "junctions": ["no"]}
    with pytest.raises(ConfigError, match="no signal 'no'"):
        build_setup(scenario, tmp_path)


def test_mounts_stand_at_every_junction_or_at_theirs(grid: RoadMap) -> None:
    mounts = [{"id": "rsu-0", "tls": None}, {"id": "extra", "tls": "B1"}]
    scenario = resolved({"regions": 2, "roadside_mounts": mounts}, grid)
    assert len(scenario["roadside_mounts"]) == 17
    assert scenario["asked"] == {"regions": 2, "roadside_mounts": mounts}
    by_region = [mounts_in(scenario, region) for region in scenario["regions"]]
    assert sum(map(len, by_region)) == 17
    with pytest.raises(ConfigError, match="extra stands at 'Z9', which is none"):
        resolved({"roadside_mounts": [{"id": "extra", "tls": "Z9"}]}, grid)


def test_each_region_has_its_processes_and_their_ids_say_so(grid: RoadMap) -> None:
    scenario = resolved({"regions": 2, "roadside_mounts": [{"id": "m", "tls": "A0"}]}, grid)
    found = instances_of(scenario | {"processes": {"vehicle": 2}})
    ids = [one.id for one in found]
    assert ids[:3] == ["router", "sim", "record"]
    assert ids[3:7] == ["edge-r0", "edge-r1", "signal-r0", "signal-r1"]
    (home,) = [region for region, junctions in scenario["regions"].items() if "A0" in junctions]
    assert ids[7:] == [f"infra-{home}", "vehicle-0", "vehicle-1"]  # posts where there are any
    assert all(parse_id(one.id) == one for one in found)
    assert [region_of(name) for name in ("edge-a.b", "vehicle-3", "nobody")] == ["a.b", "", ""]
