"""Scans are registered to the static map; agents' offsets are estimated and corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.alignment import LEAST_KNOWN, Align, OffsetFilter
from edge_server.frame import Chunk, Frame, FrameState
from edge_server.static_map import SEEN, Fit, StaticMap, structure
from perception.arrays import Floats, Floats32
from perception.roadway import Placed, Roadway
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment
from tests.roads import street

OFF = np.array([0.3, -0.2, 0.05, np.radians(0.8)])
RSU = np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
CAV = np.array([12.0, -3.0, 2.4, 0.0, 0.0, 0.3])


def _walls(*, ends: bool) -> Floats:
    """Returns a street's fronts along x, and, if wanted, gables across it; map frame."""
    rng = np.random.default_rng(2)
    along = np.column_stack(
        [rng.uniform(-50, 50, 8000), np.where(np.arange(8000) % 2, 14.0, -14.0)]
    )
    across = np.column_stack([rng.integers(-4, 5, 4000) * 12.0, rng.uniform(14, 22, 4000)])
    plan = np.concatenate([along, across]) if ends else along
    ground = np.column_stack([rng.uniform(-50, 50, 3000), rng.uniform(8, 22, 3000), np.zeros(3000)])
    walls = np.column_stack([plan, rng.uniform(0, 8, len(plan))])
    return np.concatenate([walls, ground])


OPEN, TUNNEL = _walls(ends=True), _walls(ends=False)


def _seen(world: Floats, pose: Floats, seed: int = 0) -> Floats32:
    """Returns a scan's structure from a true pose, along the map's axes from the sensor."""
    rng = np.random.default_rng(seed)
    picked = world[rng.permutation(len(world))[:6000]]
    return (picked + rng.normal(0, 0.02, picked.shape) - pose[:3]).astype(np.float32)


def _as_claimed(world: Floats, pose: Floats, off: Floats, seed: int = 0) -> Floats32:
    """Returns the same as an agent takes it whose yaw is off."""
    turn = SE3.from_pose([0, 0, 0, 0, 0, off[3]]).rotation
    return (_seen(world, pose, seed) @ turn.T).astype(np.float32)


def _map(world: Floats) -> StaticMap:
    static = StaticMap()
    for scan in range(SEEN):
        static.add(_seen(world, RSU, scan) + RSU[:3])
    return static


def test_a_map_is_ready_once_voxels_were_seen_again_and_again() -> None:
    static = StaticMap()
    static.add(np.zeros((0, 3)))
    for scan in range(SEEN):
        assert not static.is_ready
        static.add(_seen(OPEN, RSU, scan) + RSU[:3])
    assert static.is_ready
    with pytest.raises(RuntimeError, match="no map"):
        StaticMap().fit(_seen(OPEN, RSU), RSU[:3], np.zeros(4), 1.0)


def test_a_registered_scan_tells_by_how_much_its_pose_is_off() -> None:
    found = _map(OPEN).fit(_as_claimed(OPEN, CAV, OFF), CAV[:3] + OFF[:3], np.zeros(4), 1.5)
    assert found.offset[:3] == pytest.approx(OFF[:3], abs=0.04)
    assert found.offset[3] == pytest.approx(OFF[3], abs=np.radians(0.1))
    assert found.inliers > 0.8
    assert found.known > LEAST_KNOWN


def test_a_scene_that_tells_nothing_along_the_street_leaves_that_uncertain() -> None:
    found = _map(TUNNEL).fit(_as_claimed(TUNNEL, CAV, OFF), CAV[:3] + OFF[:3], np.zeros(4), 1.0)
    std = np.sqrt(np.diag(found.covariance))
    assert std[0] > 5 * std[1]
    known = OffsetFilter()
    known.update(found)
    assert known.offset[1] == pytest.approx(OFF[1], abs=0.1)
    assert not known.is_known


def test_where_a_scan_stays_only_its_fit_is_judged() -> None:
    static = _map(OPEN)
    right = static.fit(_seen(OPEN, CAV), CAV[:3], np.zeros(4), 0.0)
    wrong = static.fit(_as_claimed(OPEN, CAV, np.array([0, 0, 0, 0.3])), CAV[:3], np.zeros(4), 0.0)
    assert right.inliers > 0.8
    assert wrong.inliers < 0.5
    assert right.offset.tolist() == wrong.offset.tolist() == [0, 0, 0, 0]


def test_structure_is_off_the_road_and_a_point_a_voxel() -> None:
    road = street()
    roadway = Roadway.of(road, margin_m=0.5)
    on_road = np.array([[x, -1.75, 0.5] for x in np.linspace(20, 60, 200)])
    wall = np.array([[x, 14.0, 2.0] for x in np.linspace(20, 60, 2000)])
    nonsense = np.array([[np.nan, 3, 3], [4, 4, np.nan], [0.1, 0.1, 0.1], [900, 900, 0]])
    points = np.concatenate([on_road, wall, nonsense]).astype(np.float32)
    found = structure(points, np.array([0.0, 0, 0, 0, 0, 0]), roadway)
    assert 40 <= len(found) <= 42
    assert (found[:, 1] == 14.0).all()


def test_the_filter_finds_an_offset_and_follows_a_jump() -> None:
    rng, known = np.random.default_rng(0), OffsetFilter()
    spread = np.diag([0.05, 0.05, 0.05, 0.001]) ** 2

    def follow(offset: Floats, fits: int) -> None:
        for _ in range(fits):
            known.predict(0.5)
            seen = offset + rng.normal(0, 1, 4) * np.array([0.05, 0.05, 0.05, 0.002])
            known.update(Fit(seen, spread, 500, 0.9))

    follow(OFF, 30)
    assert known.is_known
    assert known.offset == pytest.approx(OFF, abs=0.08)
    follow(OFF + np.array([1.0, 0, 0, 0]), 6)
    assert known.offset[0] == pytest.approx(OFF[0] + 1.0, abs=0.12)
    for _ in range(2000):
        known.predict(10.0)
    assert (known.std <= np.array([0.3, 0.3, 0.2, np.radians(1.0)]) + 1e-9).all()


def _frame(number: int, claimed: Floats, scan: Floats32) -> Frame:
    """Returns a frame of a roadside unit and of a CAV with a car ahead of it at (20, -3)."""
    time_ns = number * 100_000_000
    own = AgentPose(
        frame=number,
        sim_time_ns=time_ns,
        agent="cav",
        equipment=Equipment.CAV,
        pose=claimed - np.array([0, 0, 2.4, 0, 0, 0]),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    )
    turn = SE3.from_pose([0, 0, 0, 0, 0, claimed[5] - CAV[5]])
    car = turn.apply(np.array([[20.0, -3.0, 0.8]]) - CAV[:3]) + claimed[:3]
    placed = Placed.of(car.astype(np.float32), np.zeros(1, np.float32))
    nothing = np.zeros((0, 3), np.float32)
    base = Chunk(number, time_ns, "cav", 0, 1, claimed, nothing, 0, structure=scan, placed=placed)
    post = replace(base, agent="rsu-0", sensor_pose=RSU, structure=_seen(OPEN, RSU, number))
    return Frame(number, time_ns, ["cav", "rsu-0"], [own], [base, post], True, 0, 0)


def _aligned(align: Align, off: Floats, frames: range, scan: Floats32) -> FrameState:
    claimed = CAV + np.array([*off[:3], 0, 0, off[3]])
    for number in frames:
        state = FrameState(_frame(number, claimed, scan))
        align.run(state)
    return state


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_scans_and_poses_of_a_misplaced_agent_are_corrected(scale: float) -> None:
    off = OFF * scale
    state = _aligned(Align({"rsu-0"}), off, range(30), _as_claimed(OPEN, CAV, off))
    cav, post = state.frame.chunks
    assert cav.sensor_pose == pytest.approx(CAV, abs=0.06)
    assert cav.placed is not None
    assert cav.placed.points[0, :2] == pytest.approx([20.0, -3.0], abs=0.08)
    assert cav.placed.lowest[0, :2] == pytest.approx([20.0, -3.0], abs=0.08)
    assert state.frame.poses[0].pose[:2] == pytest.approx(CAV[:2], abs=0.06)
    assert post.sensor_pose is RSU
    (alignment,) = state.alignments
    assert (alignment.agent, alignment.excluded) == ("cav", False)
    assert (alignment.x_m, alignment.y_m) == pytest.approx(tuple(off[:2]), abs=0.06)


def test_an_agent_whose_scans_contradict_the_scene_is_excluded_and_returns() -> None:
    align = Align({"rsu-0"})
    odd = _seen(np.random.default_rng(5).uniform([-50, 8, 0], [50, 22, 8], (9000, 3)), CAV)
    state = _aligned(align, np.zeros(4), range(20), odd)
    assert state.frame.agents == ["rsu-0"]
    assert state.excluded["misaligned"] == 1
    assert state.alignments[0].excluded
    state = _aligned(align, np.zeros(4), range(20, 50), _seen(OPEN, CAV))
    assert state.frame.agents == ["cav", "rsu-0"]


def test_an_agent_where_nothing_is_known_stays_as_it_claims() -> None:
    align = Align({"rsu-0"})
    _aligned(align, OFF, range(5), _as_claimed(OPEN, CAV, OFF) + np.float32(500))
    state = _aligned(align, OFF, range(5, 15), _as_claimed(OPEN, CAV, OFF) + np.float32(500))
    assert state.frame.agents == ["cav", "rsu-0"]
    assert state.frame.poses[0].pose[0] == CAV[0] + OFF[0]
    assert state.alignments[0].points == 0


def test_without_roadside_units_the_first_agent_begins_the_map() -> None:
    align = Align({})
    for number in range(12):
        frame = _frame(number, CAV, _seen(OPEN, CAV, number))
        state = FrameState(replace(frame, agents=["cav"], chunks=frame.chunks[:1]))
        align.run(state)
    assert state.alignments[0].inliers > 0.8
    assert state.frame.poses[0].pose[:2] == pytest.approx(CAV[:2], abs=0.05)
