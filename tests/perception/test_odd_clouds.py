"""Contrived point clouds: every detector ends soon and is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from edge_server.config import EdgeConfig
from edge_server.pipeline import Pipeline
from perception import reference
from perception.cluster import NOISE, _by_parts, _compare, cluster
from perception.config import ClusterConfig, DetectionConfig
from perception.detector import Cloud, Detector, Vehicles
from perception.registry import detector_of
from perception.roadway import Placed, Roadway
from perception.votes import lowest
from protocol.geometry import SE3
from protocol.regions import RegionMap
from tests.edge_server.made_frames import ROADSIDE, frame_of
from tests.roads import junction_road

MANY = 2_000_000
NEEDS = {"reference": "open3d", "pointpillars": "torch"}
DETECTORS = ["fast", "reference", "pointpillars"]
Floats32 = np.ndarray


@cache
def roadway() -> Roadway:
    return Roadway.of(junction_road(), margin_m=0.5)


def need(name: str) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"{name} needs an extra", exc_type=ImportError)


@cache
def detector(name: str) -> Detector:
    return detector_of(DetectionConfig.model_validate({"detector": name}), roadway())


def detect(name: str, points: Floats32, *, bare: bool = False) -> Vehicles:
    need(name)
    part = Placed.of(points, np.zeros(len(points), np.float32))
    cloud = Cloud([] if bare else [part], [part] if bare else [], np.array([[0, 0, 3.0]]))
    found = detector(name).detect(cloud, np.random.default_rng(1))
    assert found.boxes.shape == (len(found), 7)
    assert np.isfinite(found.boxes).all()
    assert np.isfinite(found.scores).all()
    return found


def spot(count: int) -> Floats32:
    return np.tile(np.array([[-30, 1.75, 1]], np.float32), (count, 1))


def within(low: list[float], high: list[float], count: int) -> Floats32:
    return np.random.default_rng(1).uniform(low, high, (count, 3)).astype(np.float32)


def ground(count: int) -> Floats32:
    return within([-155, -3.5, -0.02], [155, 3.5, 0.02], count)


def wall(count: int) -> Floats32:
    return within([-40, 1.7, 0], [-20, 1.8, 5], count)


def everywhere(count: int) -> Floats32:
    return within([-155, -3.5, -0.1], [155, 3.5, 1.8], count)


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize(
    "points",
    [ground(0), spot(1), spot(40_000), ground(40_000), wall(10_000)],
    ids=["empty", "one point", "one spot", "all ground", "a wall"],
)
def test_where_there_is_no_vehicle_none_is_found(name: str, points: Floats32) -> None:
    assert len(detect(name, points)) == 0


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("points", [ground(0), spot(1), spot(40_000), wall(10_000)])
def test_nor_where_the_ground_was_taken_away_before(name: str, points: Floats32) -> None:
    assert len(detect(name, points, bare=True)) == 0


@pytest.mark.parametrize("name", ["fast", "pointpillars"])
@pytest.mark.parametrize("cloud", [spot, everywhere, ground])
def test_millions_of_points_are_taken(name: str, cloud: Callable[[int], Floats32]) -> None:
    detect(name, cloud(MANY))


def test_the_reference_keeps_no_list_of_a_trillion_neighbours() -> None:
    assert len(detect("reference", spot(MANY // 4), bare=True)) == 0


def test_where_open3d_would_list_too_much_the_reference_finds_the_same(
    monkeypatch: pytest.MonkeyPatch, car_shell: Callable[..., Any]
) -> None:
    rng = np.random.default_rng(2)
    cars = [car_shell([x, 1.75, 0, 0, 0, 0], (0.0, 0.0), rng, points=900) for x in (-40, -20, 30)]
    cars = np.concatenate(cars)
    whole = detect("reference", cars, bare=True)
    monkeypatch.setattr(reference, "MOST_PAIRS", 0)
    monkeypatch.setattr(reference, "AT_ONCE", 100)
    np.testing.assert_allclose(detect("reference", cars, bare=True).boxes, whole.boxes, atol=1e-9)
    assert len(whole) == 3


def corner(count: int) -> Floats32:
    """One set in a spot, one in two: near the bounds of the second, but near none of its points."""
    low, high = np.float32(1.444), np.float32(2.163)
    at = low - 1.25 / np.sqrt(2) + 0.01
    spots = [[at, at, 0.5], [low, high, 0.5], [high, low, 0.5]]
    points = np.repeat(spots, [count // 2, count // 4, count // 4], axis=0)
    return np.concatenate([[[0, 0, 0.5]], points]).astype(np.float32)


def around(count: int) -> Floats32:
    """A dense spot and, at the distance of neighbours to within a hair, points on a ball."""
    rng = np.random.default_rng(3)
    way = rng.uniform([0.46, 0.46, 0.46], [0.65, 0.65, 0.65], (count // 2, 3))
    way *= (1.25 + 1e-5) / np.linalg.norm(way, axis=1)[:, None]
    near = rng.uniform(0.7, 0.701, (count // 2, 3))
    return np.concatenate([[[0, 0, 0]], near, 0.7005 + way]).astype(np.float32)


@pytest.mark.parametrize(("cloud", "clusters"), [(corner, {2}), (around, {1, 2})])
def test_points_made_up_to_be_compared_all_with_all_are_not(
    cloud: Callable[[int], Floats32], clusters: set[int]
) -> None:
    for count in (2000, MANY // 2):  # one by one, the larger would take minutes
        assert cluster(cloud(count), config=ClusterConfig()).max() + 1 in clusters


def test_parts_that_touch_are_those_whose_points_do() -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        sizes = rng.integers(1, 800, 2)
        points = rng.uniform(0, 0.72, (sizes.sum(), 3)).astype(np.float32)
        points[sizes[0] :] += rng.integers(0, 3, 3).astype(np.float32) * np.float32(0.72)
        one, other = np.split(np.arange(sizes.sum()), sizes[:1])
        apart = points[one, None].astype(np.float64) - points[None, other]
        nearest_m2 = (apart**2).sum(axis=2).min()
        for square_m2 in (1.25**2, nearest_m2, 0.999 * nearest_m2, 1.001 * nearest_m2):
            expected = _compare(points, one, other, square_m2)
            assert _by_parts(points, one.copy(), other.copy(), square_m2) == expected


def test_identical_points_are_one_cluster_or_noise() -> None:
    assert set(cluster(spot(MANY), config=ClusterConfig())) == {0}
    assert set(cluster(spot(2), config=ClusterConfig())) == {NOISE}


def test_points_at_the_ends_of_the_world_take_no_map_of_it() -> None:
    far = np.array([[-1e6, -1e6, 3], [0, 0, 2], [1e6, 1e6, 1]], np.float32)
    votes = lowest(far, np.zeros(3, np.float32))
    np.testing.assert_array_equal(votes[np.argsort(votes[:, 0])], far)


HOSTILE = [np.nan, np.inf, -np.inf, 1e6, -1e6, 3e38, -3e38]


def hostile() -> Floats32:
    """Points with one coordinate, or all, that no point on the road has."""
    points = np.repeat([[5, 1, 1]], 4 * len(HOSTILE), axis=0).astype(np.float32)
    for number, value in enumerate(HOSTILE):
        for axis in range(3):
            points[4 * number + axis, axis] = value
        points[4 * number + 3] = value
    return points


def test_points_that_are_no_place_are_left_out() -> None:
    placed = roadway().place(hostile(), SE3.from_pose(ROADSIDE), below_m=2, above_m=5)
    assert len(placed.points) == len(placed.road_m) == len(placed.lowest) == 0


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("ground_free", [False, True])
def test_an_agent_that_sends_them_changes_nothing_of_what_others_see(
    name: str, ground_free: bool, car_shell: Callable[..., Any], ground: Callable[..., Any]
) -> None:
    need(name)
    region = RegionMap.whole(junction_road(0.035))
    pipeline = Pipeline.of(region, EdgeConfig.model_validate({"detector": name}), seed=1)
    frame = frame_of(car_shell, ground)
    bad = replace(frame.chunks[0], agent="bad", points=hostile(), ground_free=ground_free)
    honest, spoilt = (
        pipeline.run(replace(frame, chunks=chunks)).detections
        for chunks in (frame.chunks, [*frame.chunks, bad])
    )
    assert len(honest.boxes) > 0
    assert np.isfinite(spoilt.boxes).all()
    if name != "reference":  # Open3D's planes differ a little from call to call
        np.testing.assert_array_equal(honest.boxes, spoilt.boxes)
        np.testing.assert_array_equal(honest.scores, spoilt.scores)
        assert honest.lanes == spoilt.lanes
