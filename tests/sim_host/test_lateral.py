"""Where in their lanes vehicles drive."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import ObjectClass, VehicleType
from sim_host.config import LateralConfig
from sim_host.lateral import LateralPositions
from sim_host.setup import build_setup
from sim_host.world import Ground, TrafficState, World

CAR = VehicleType(name="car", mesh="car", length_m=4.5, width_m=1.8, height_m=1.5)
LORRY = VehicleType(name="lorry", mesh="lorry", length_m=8.5, width_m=2.5, height_m=3.4)
BICYCLE = VehicleType(
    name="bicycle",
    mesh="bicycle",
    length_m=1.8,
    width_m=0.65,
    height_m=1.75,
    object_class=ObjectClass.TWO_WHEELER,
)
DRIFT = LateralConfig(offset_std_m=0.2, wander_std_m=0.15, bicycle_edge_m=0.8)


def offsets(config: LateralConfig, kind: VehicleType, driven_m: np.ndarray, seed: int = 1) -> Any:
    names = [f"v{n}" for n in range(len(driven_m))]
    widths_m = np.full(len(names), 3.5)
    return LateralPositions(config, seed).offsets_m(names, [kind] * len(names), driven_m, widths_m)


@given(st.floats(0, 1), st.floats(0, 1), st.sampled_from([CAR, LORRY, BICYCLE]), st.integers(0, 99))
def test_nobody_leaves_his_lane(
    offset_std_m: float, wander_std_m: float, kind: VehicleType, seed: int
) -> None:
    config = LateralConfig(offset_std_m=offset_std_m, wander_std_m=wander_std_m, bicycle_edge_m=0.8)
    off_m, _ = offsets(config, kind, np.linspace(0, 900, 50), seed)
    assert (np.abs(off_m) + kind.width_m / 2 < 3.5 / 2 - 0.1).all()


def test_cars_are_spread_as_asked_for() -> None:
    off_m, _ = offsets(DRIFT, CAR, np.full(3000, 120.0))
    assert np.mean(off_m) == pytest.approx(0, abs=0.02)
    assert np.std(off_m) == pytest.approx(0.25, abs=0.04)  # of both together


def test_bicycles_ride_near_the_right_edge() -> None:
    off_m, _ = offsets(DRIFT, BICYCLE, np.full(2000, 50.0))
    assert np.median(off_m) == pytest.approx(0.8 - 3.5 / 2, abs=0.03)


def test_the_heading_follows_the_drift() -> None:
    positions = LateralPositions(DRIFT, 1)
    along_m = np.linspace(0, 400, 4001)
    found = [positions.offsets_m(["v"], [CAR], np.array([s]), np.array([3.5])) for s in along_m]
    off_m, slope_rad = np.array(found)[:, :, 0].T
    np.testing.assert_allclose(np.tan(slope_rad), np.gradient(off_m, along_m), atol=1e-4)
    assert np.abs(slope_rad).max() < np.radians(2)


def play(folder: Path, flat: Ground, lateral: dict[str, Any]) -> list[TrafficState]:
    setup = build_setup({"traffic": {"lateral": lateral}}, folder)
    world = World(setup, folder, flat)
    world.start(1)
    try:
        states = []
        for _ in range(900):
            world.step()
            states.append(world.bodies())
        return states
    finally:
        world.close()


def most_aside_m(states: list[TrafficState]) -> float:
    """Returns the farthest that a body moved aside from one state to the next."""
    most = 0.0
    for before, now in pairwise(states):
        at = {name: n for n, name in enumerate(before.ids)}
        for n, name in enumerate(now.ids):
            if name in at:
                step = now.poses[n, :2] - before.poses[at[name], :2]
                yaw = now.poses[n, 5]
                most = max(most, abs(float(step @ (-np.sin(yaw), np.cos(yaw)))))
    return most


def test_a_lane_change_takes_time(tmp_path_factory: pytest.TempPathFactory, flat: Ground) -> None:
    at_once = play(tmp_path_factory.mktemp("run"), flat, {})
    slowly = play(tmp_path_factory.mktemp("run"), flat, {"lane_change_s": 5})
    assert most_aside_m(at_once) > 3.0
    assert most_aside_m(slowly) < 0.7  # what SUMO's bends at the stop bars leave


def test_who_changes_lanes_slowly_or_stands_does_not_turn_across_them(
    tmp_path_factory: pytest.TempPathFactory, flat: Ground
) -> None:
    states = play(tmp_path_factory.mktemp("run"), flat, {"lane_change_s": 5})
    off_rad, turned = [], 0
    for state in states:
        for lane, pose, along_m in zip(
            state.lanes, state.poses, state.lane_positions_m, strict=True
        ):
            if lane.startswith(("west_in", "east_out")):  # both head east
                off_rad.append(pose[5])
                turned += along_m < 4 and abs(pose[5]) > 0.1
    assert np.abs(off_rad).max() < np.radians(20)  # whose rear still turns out of the side road
    assert np.quantile(np.abs(off_rad), 0.999) < np.radians(9)
    assert turned


def test_drift_is_in_the_poses_and_the_same_again(
    tmp_path_factory: pytest.TempPathFactory, flat: Ground
) -> None:
    drift = {"offset_std_m": 0.2, "wander_std_m": 0.15}
    middle, one, same = (
        play(tmp_path_factory.mktemp("run"), flat, lateral)[-1] for lateral in ({}, drift, drift)
    )
    assert middle.ids == one.ids == same.ids
    np.testing.assert_array_equal(one.poses, same.poses)
    aside_m = np.linalg.norm((one.poses - middle.poses)[:, :2], axis=1)
    assert 0.1 < np.mean(aside_m) < 0.4
    np.testing.assert_array_equal(one.lane_positions_m, middle.lane_positions_m)
