"""Neighbouring regions: each vehicle is published once, by the region of its lane."""

from collections import Counter
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.border import MAX_KEPT_FRAMES, BorderExchange, BorderStrips
from edge_server.config import EdgeConfig
from edge_server.coverage import SensorViews
from edge_server.frame import Frame, FrameState
from edge_server.lanes import LaneIndex
from edge_server.pipeline import Border, Count
from edge_server.tracking import Track
from perception.detector import Vehicles
from protocol.messages import BorderObjects, Detections
from protocol.regions import RegionMap, regions_of
from protocol.roadmap import Lane, RoadMap
from sim_host.netfile import read_net
from sim_host.networks import write_corridor
from sim_host.road_map import road_map
from tests.messages import no_tracks

CONFIG = EdgeConfig()
NOWHERE = np.zeros((0, 2))


@cache
def corridor() -> RoadMap:
    with TemporaryDirectory() as folder:
        return road_map(read_net(write_corridor(Path(folder))), "all")


class Edge:
    """What an edge does with a frame once its sensors' vehicles are found."""

    def __init__(self, region: RegionMap, regions: dict[str, RegionMap]) -> None:
        self.region = region
        self.strips = BorderStrips(region, regions)
        lanes = LaneIndex(region.surroundings)
        self.stages = [
            Border(self.strips, CONFIG.fusion),
            Track(region.surroundings, CONFIG.tracking, self.strips),
            Count(region, lanes, CONFIG, has_lidars=True, strips=self.strips),
        ]

    def begin(
        self, boxes: list[tuple[float, ...]], number: int = 0
    ) -> tuple[FrameState, BorderObjects]:
        frame = Frame(
            number, number * 10**8, ["rsu"], [], [], complete=True, first_ns=0, ready_ns=0
        )
        state = FrameState(frame)
        values = np.array(boxes, np.float64).reshape(-1, 7)
        state.fused = Vehicles.from_lidar(values, np.ones(len(values)))
        state.sensors = SensorViews.of(NOWHERE)
        return state, self.strips.message_of(state)

    def finish(self, state: FrameState, sent: dict[str, BorderObjects]) -> Detections:
        state.received = {name: sent[name] for name in self.strips.neighbours}
        for stage in self.stages:
            stage.run(state)
        return state.detections


def box_on(lane: Lane, along_m: float) -> tuple[float, ...]:
    """Returns a car's box so far along a lane."""
    steps = np.diff(lane.points, axis=0)
    ends_m = np.concatenate([[0], np.cumsum(np.hypot(*steps[:, :2].T))])
    x, y, z = (np.interp(along_m, ends_m, column) for column in lane.points.T)
    dx, dy, _ = steps[min(int(np.searchsorted(ends_m, along_m)), len(steps)) - 1]
    return (x, y, z + 0.75, 4.5, 1.8, 1.5, float(np.arctan2(dy, dx)))


@settings(max_examples=12, deadline=None)
@given(st.lists(st.integers(0, 4), min_size=5, max_size=5), st.integers(0, 2**32 - 1))
def test_whatever_the_cut_a_vehicle_is_told_of_once_by_the_region_of_its_lane(cut, seed):
    roads, rng = corridor(), np.random.default_rng(seed)
    regions: dict[str, list[str]] = {}
    for tls, part in zip(sorted(roads.by_tls), cut, strict=True):
        regions.setdefault(f"r{part}", []).append(tls)
    scenario = {"regions": regions, "edge": CONFIG.model_dump()}
    maps = regions_of(roads, scenario)
    seen: dict[str, list[tuple[float, ...]]] = {name: [] for name in maps}
    want: Counter[tuple[str, str]] = Counter()
    for lane in (lane for lane in roads.lanes if not lane.internal and lane.length_m > 20):
        owner = next(name for name, junctions in regions.items() if lane.tls in junctions)
        for along_m in np.arange(5.0, lane.measured_m - 5.0, 15.0):
            near = [name for name, region in maps.items() if lane.id in region.area.by_id]
            seeing = [name for name in near if rng.random() < 0.6] or [str(rng.choice(near))]
            for name in seeing:  # each sees it a little elsewhere along its lane
                seen[name].append(box_on(lane, along_m + rng.uniform(-0.8, 0.8)))
            want[owner, lane.id] += 1
    edges = {name: Edge(region, maps) for name, region in maps.items()}
    states = {name: edge.begin(seen[name]) for name, edge in edges.items()}
    sent = {name: message for name, (_, message) in states.items()}
    found: Counter[tuple[str, str]] = Counter()
    for name, edge in edges.items():
        found.update((name, lane) for lane in edge.finish(states[name][0], sent).lanes)
    assert found == want


def halves() -> dict[str, RegionMap]:
    names = sorted(corridor().by_tls)
    regions = {"west": names[:2], "east": names[2:]}
    return regions_of(corridor(), {"regions": regions, "edge": CONFIG.model_dump()})


def test_a_vehicle_keeps_its_id_from_region_to_region():
    """It drives from the west's last lane to the east's first, seen by both where both see."""
    maps = halves()
    edges = {name: Edge(region, maps) for name, region in maps.items()}
    roads = corridor().by_id
    ways = [
        [first, roads[inside], roads[after]]
        for first in corridor().lanes
        for inside in first.successors
        for after in roads[inside].successors
        if not first.internal
    ]
    first, inside, after = next(
        way for way in ways
        if way[0].tls in maps["west"].area.by_tls and way[2].tls in maps["east"].area.by_tls
    )  # fmt: skip
    last_m = first.measured_m
    way = [(first, along_m) for along_m in np.arange(last_m - 60, last_m, 1.0)]
    way += [(inside, along_m) for along_m in np.arange(0.5, inside.measured_m, 1.0)]
    way += [(after, along_m) for along_m in np.arange(0.5, after.measured_m, 1.0)]
    ids: dict[str, set[int]] = {"west": set(), "east": set()}
    for number, (one, along_m) in enumerate(way):
        box = box_on(one, float(along_m))
        states = {
            name: edge.begin([box] if one.id in maps[name].area.by_id else [], number)
            for name, edge in edges.items()
        }
        sent = {name: message for name, (_, message) in states.items()}
        for name, edge in edges.items():
            ids[name].update(edge.finish(states[name][0], sent).track_ids.tolist())
    assert ids["west"] == ids["east"]
    assert len(ids["west"]) == 1


def test_regions_that_share_no_lane_are_no_neighbours():
    names = sorted(corridor().by_tls)
    regions = {"a": names[:1], "b": names[1:4], "c": names[4:]}
    maps = regions_of(corridor(), {"regions": regions, "edge": CONFIG.model_dump()})
    neighbours = {name: BorderStrips(one, maps).neighbours for name, one in maps.items()}
    assert neighbours == {"a": ["b"], "b": ["a", "c"], "c": ["b"]}


def test_what_a_neighbour_covers_is_covered_and_without_it_unknown():
    maps = halves()
    west = Edge(maps["west"], maps)
    tls, shared = next(
        (one.tls, lane)
        for one in maps["west"].area.intersections
        for lane in one.outgoing
        if lane in maps["east"].area.by_id
    )
    middle = maps["west"].area.by_id[shared].points.mean(axis=0)[:2]
    sent = BorderObjects(
        frame=0, sim_time_ns=0, boxes=np.zeros((0, 7), np.float32), scores=np.zeros(0, np.float32),
        classes=np.zeros(0, np.uint8),
        sources=[], position_std_m=np.zeros(0, np.float32), sensors=middle[None], **no_tracks(),
    )  # fmt: skip
    for received, is_covered in (({"east": sent}, True), ({}, False)):
        state, _ = west.begin([])
        state.received = received
        for stage in west.stages:
            stage.run(state)
        covered = state.counts[tls].coverage_downstream[shared]
        assert (covered > 0) is is_covered


@pytest.fixture
def exchange() -> BorderExchange:
    maps = halves()
    return BorderExchange(BorderStrips(maps["west"], maps))


def border_message(frame: int) -> BorderObjects:
    empty = np.zeros(0, np.float32)
    return BorderObjects(
        frame=frame, sim_time_ns=frame, boxes=np.zeros((0, 7), np.float32), scores=empty,
        classes=np.zeros(0, np.uint8),
        sources=[], position_std_m=empty, sensors=NOWHERE, **no_tracks(),
    )  # fmt: skip


def waiting(exchange: BorderExchange, frame: int, wait_ns: int = 10**12) -> FrameState:
    state = FrameState(Frame(frame, 0, [], [], [], complete=True, first_ns=0, ready_ns=0))
    state.fused, state.sensors = (
        Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0)),
        SensorViews.of(NOWHERE),
    )
    exchange.begin(state, wait_ns)
    return state


def test_a_frame_waits_for_neighbours_that_are_there_and_for_no_others(exchange):
    waiting(exchange, 3)
    assert exchange.is_due(0)  # no neighbour is present
    exchange.note_edge("east", alive=True)
    assert not exchange.is_due(0)
    assert exchange.take("east", border_message(3))
    assert exchange.is_due(0)
    assert exchange.end().received.keys() == {"east"}
    assert not exchange.is_due(0)


def test_a_frame_does_not_wait_for_ever_and_what_comes_later_is_told_apart(exchange):
    exchange.note_edge("east", alive=True)
    waiting(exchange, 3, wait_ns=0)
    assert exchange.is_due(10**18)
    assert exchange.end().received == {}
    assert not exchange.take("east", border_message(3))
    assert not exchange.take("stranger", border_message(4))


def test_what_a_neighbour_tells_ahead_is_bounded(exchange):
    for frame in range(3 * MAX_KEPT_FRAMES):
        exchange.take("east", border_message(frame))
    waiting(exchange, 3 * MAX_KEPT_FRAMES - 1)
    exchange.note_edge("east", alive=True)
    assert exchange.is_due(0)


@pytest.mark.parametrize(
    ("wrong", "error_text"),
    [
        ({"sensors": np.zeros((4097, 2))}, "4097 sensors, limit 4096"),
        ({"sources": ["lidar"]}, "need one"),
        ({"sensors": np.full((1, 2), 1e8)}, "beyond 1e7"),
    ],
)
def test_what_a_neighbour_publishes_is_bounded(wrong, error_text):
    with pytest.raises(ValueError, match=error_text):
        BorderObjects.model_validate({**border_message(1).__dict__, **wrong})


@pytest.mark.parametrize("std_m", [-1.0, 1001.0])
def test_a_neighbours_poses_have_an_error_that_can_be(std_m):
    one = {
        "boxes": np.zeros((1, 7)), "scores": np.ones(1), "sources": ["a"],
        "classes": np.zeros(1, np.uint8),
        "position_std_m": np.array([std_m]),
    }  # fmt: skip
    with pytest.raises(ValueError, match="not within 0 to 1000 m"):
        BorderObjects.model_validate({**border_message(1).__dict__, **one})
