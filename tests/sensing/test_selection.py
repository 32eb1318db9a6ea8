"""What the policies let through, on scans of a full street."""

from __future__ import annotations

import numpy as np
import pytest

from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.messages import Plan
from protocol.roadmap import RoadMap
from protocol.scans import RangeScan
from sensing.config import LidarConfig, UploadConfig
from sensing.lidar import Lidar
from sensing.mesh import VehicleShapes
from sensing.scene import Scene
from sensing.upload_filters import LEARNT_FRAMES, locate
from sensing.upload_policies import POLICIES, PolicyName
from sensing.upload_selection import Selection, Selector

CONFIG = LidarConfig(channels=32, points_per_second=288_000)
AGENTS = ["a", "b", "c"]
SITES = np.array([[0.0, 0], [-60, -1.75], [40, 1.75]])


@pytest.fixture(scope="module")
def lidar(scene: Scene, shapes: VehicleShapes) -> Lidar:
    return Lidar(CONFIG, scene, shapes)


@pytest.fixture(scope="module")
def post(scene: Scene) -> SE3:
    return SE3.from_pose([0, 0, 4 + float(scene.terrain.height_m([[0, 0]])[0]), 0, 0, 0])


@pytest.fixture(scope="module")
def roadway(road_map: RoadMap) -> Roadway:
    return Roadway.of(road_map, margin_m=1.0)


def plan(frame: int = 3) -> Plan:
    plain = np.array([0.0, 300, -200])
    weights_m2 = np.stack([plain - 250, plain, plain + 200], axis=1)
    return Plan(
        frame=frame,
        agent="a",
        mbps=1,
        enough=frame - 1,
        agents=AGENTS,
        sites=SITES,
        weights_m2=weights_m2,
    )


def selector(policy: PolicyName, roadway: Roadway, *, stationary: bool = False) -> Selector:
    chosen = UploadConfig(policy=policy).of("vehicle")
    return Selector(
        POLICIES[policy],
        chosen.filters,
        roadway,
        CONFIG.pattern,
        thin_m=0.1,
        stationary=stationary,
    )


def scan(lidar: Lidar, pose: SE3, traffic: tuple[np.ndarray, list[str]], frame: int) -> RangeScan:
    return lidar.scan(pose, *traffic, None, np.random.default_rng(frame)).scan


def sent(selection: Selection, of: RangeScan) -> np.ndarray:
    return np.asarray((selection.chunk < selection.chunks) & (of.range_m > 0))


def test_full_sends_the_scan_as_it_is(lidar, post, roadway, traffic) -> None:
    one = scan(lidar, post, traffic, 0)
    selection = selector("full", roadway).select(one, post, "a", None)
    assert selection.chunks == 1
    assert selection.part(one, 0) is one


@pytest.mark.parametrize("policy", ["roi", "foreground", "voronoi", "power", "reap"])
@pytest.mark.parametrize("stationary", [True, False])
def test_a_beam_goes_into_one_chunk_at_most_and_chunks_hold_what_came_back(
    policy, stationary, lidar, post, roadway, traffic
) -> None:
    one = scan(lidar, post, traffic, 0)
    selection = selector(policy, roadway, stationary=stationary).select(one, post, "a", plan())
    parts = [selection.part(one, chunk) for chunk in range(selection.chunks)]
    held = np.array([part.range_m > 0 for part in parts])
    assert (held.sum(axis=0) <= 1).all()
    np.testing.assert_array_equal(held.any(axis=0), sent(selection, one))
    for chunk, part in enumerate(parts):
        np.testing.assert_array_equal(part.range_m > 0, selection.mask(chunk) & (one.range_m > 0))
        np.testing.assert_array_equal(part.range_m[held[chunk]], one.range_m[held[chunk]])


def test_what_the_edge_keeps_of_a_scan_is_within_the_road_of_roi(
    lidar, post, roadway, traffic, road_map
) -> None:
    one = scan(lidar, post, traffic, 0)
    part = selector("roi", roadway).select(one, post, "a", None).part(one, 0)
    fence = Roadway.of(road_map, margin_m=0.5)
    whole, less = (
        fence.place(s.cloud().points, post, below_m=1.9, above_m=4.9) for s in (one, part)
    )
    np.testing.assert_array_equal(whole.points, less.points)
    assert np.count_nonzero(part.range_m) < 0.7 * np.count_nonzero(one.range_m)


def on_cars(
    lidar: Lidar, pose: SE3, traffic: tuple[np.ndarray, list[str]], roadway: Roadway, one: RangeScan
) -> tuple[np.ndarray, np.ndarray]:
    """Returns which beams came back from a vehicle, and which from one on the road."""
    with_cars = lidar.view(pose, *traffic, None).distance_m
    without = lidar.view(pose, np.zeros((0, 6)), [], None).distance_m
    met = (with_cars < without - 1e-3) & (one.range_m > 0)
    on_road = ~np.isnan(locate(one, pose, roadway).above_m).reshape(one.range_m.shape)
    return met, met & on_road


@pytest.mark.parametrize("stationary", [True, False])
def test_foreground_keeps_the_cars_and_little_else(
    stationary, lidar, post, roadway, traffic
) -> None:
    chooses = selector("foreground", roadway, stationary=stationary)
    nobody: tuple[np.ndarray, list[str]] = (np.zeros((0, 6)), [])
    for frame in range(3 * LEARNT_FRAMES):
        chooses.select(scan(lidar, post, nobody, frame), post, "a", None)
    one = scan(lidar, post, traffic, 99)
    kept = sent(chooses.select(one, post, "a", None), one)
    met, car = on_cars(lidar, post, traffic, roadway, one)
    assert (kept & car).sum() > (0.98 if stationary else 0.9) * car.sum()
    assert (kept & ~met).sum() < 0.01 * (one.range_m > 0).sum()


def test_a_car_that_waits_from_the_first_frame_on_does_not_become_background(
    lidar, post, roadway, traffic
) -> None:
    chooses = selector("foreground", roadway, stationary=True)
    for frame in range(5 * LEARNT_FRAMES):
        one = scan(lidar, post, traffic, frame)
        kept = sent(chooses.select(one, post, "a", None), one)
    _, car = on_cars(lidar, post, traffic, roadway, one)
    assert (kept & car).sum() > 0.9 * car.sum()


def test_what_a_sensor_learns_depends_on_its_scans_alone(lidar, post, roadway, traffic) -> None:
    first, second = (selector("foreground", roadway, stationary=True) for _ in range(2))
    for frame in range(8):
        one = scan(lidar, post, traffic, frame)
        a, b = (s.select(one, post, "a", None).chunk for s in (first, second))
        np.testing.assert_array_equal(a, b)


def test_an_agent_that_no_plan_knows_sends_one_chunk(lidar, post, roadway, traffic) -> None:
    one = scan(lidar, post, traffic, 0)
    for given in (None, plan()):
        selection = selector("reap", roadway).select(one, post, "stranger", given)
        assert (selection.chunks, selection.plan_frame) == (1, -1)
        assert sent(selection, one).sum() == (one.range_m > 0).sum()


def test_all_agents_of_a_plan_share_one_place_among_them_once(
    lidar, post, roadway, traffic
) -> None:
    one = scan(lidar, post, traffic, 0)
    returned = one.range_m > 0
    shares = [selector("reap", roadway).select(one, post, agent, plan()) for agent in AGENTS]
    assert {share.plan_frame for share in shares} == {3}
    within_plain = sum((s.chunk <= 1).astype(int) for s in shares)
    within_wide = sum((s.chunk <= 2).astype(int) for s in shares)
    assert (within_plain[returned] == 1).all()
    assert (within_wide[returned] >= 1).all()
    halves = [selector("power", roadway).select(one, post, agent, plan()) for agent in AGENTS]
    assert (sum(h.mask(0).astype(int) for h in halves)[returned] == 1).all()


def test_vehicles_and_roadside_may_choose_for_themselves() -> None:
    config = UploadConfig.model_validate(
        {"policy": "reap", "filters": ["roi"], "roadside": {"policy": "full", "filters": []}}
    )
    assert config.of("vehicle").policy == "reap"
    assert config.of("vehicle").filters == {"roi"}
    assert config.of("roadside").policy == "full"
    assert config.of("roadside").filters == frozenset()


def test_two_kinds_of_cells_are_refused() -> None:
    with pytest.raises(ValueError, match="share one plan"):
        UploadConfig.model_validate({"policy": "reap", "roadside": {"policy": "voronoi"}})
    with pytest.raises(ValueError, match="policy"):
        UploadConfig.model_validate({"policy": "some"})
