"""Motion check: whether an agent can have moved to its claimed pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_server.misbehaviour import TrustScore
from edge_server.motion import STEADY_FRAMES, ClaimedPose, MotionCheck, fastest_mps
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment

PERIOD_NS = 100_000_000
FAST_MPS = fastest_mps([13.9])


def stand(frame: int, x_m: float, *, yaw_deg: float = 0.0, std_m: float = 0.05) -> ClaimedPose:
    pose = np.array([x_m, 0, 0, 0, 0, np.radians(yaw_deg)])
    return ClaimedPose(frame * PERIOD_NS, pose, std_m, is_rsu=False)


@given(st.floats(0, 20), st.floats(0, 3), st.integers(1, 40))
def test_whoever_drives_is_trusted_also_over_gaps(
    speed_mps: float, std_m: float, every: int
) -> None:
    motion, rng = MotionCheck(), np.random.default_rng(1)
    for frame in range(0, 200, every):
        x_m = speed_mps * frame / 10 + float(rng.normal(0, std_m))
        assert motion.score(stand(frame, x_m, std_m=std_m), FAST_MPS) == 1.0


def test_whoever_jumps_is_doubted_until_it_has_been_steady_in_the_new_place():
    motion = MotionCheck()
    scores = [motion.score(stand(f, f if f < 10 else f + 50.0), FAST_MPS) for f in range(60)]
    assert scores[:10] == [1.0] * 10
    assert scores[10 : 11 + STEADY_FRAMES] == [0.0] * (STEADY_FRAMES + 1)
    assert set(scores[11 + STEADY_FRAMES :]) == {1.0}


def test_whoever_jumps_all_the_time_is_never_believed():
    motion = MotionCheck()
    scores = [motion.score(stand(f, 40.0 * (f % 2)), FAST_MPS) for f in range(100)]
    assert scores == [1.0, 0.0] * 50


def test_nobody_turns_on_the_spot():
    motion = MotionCheck()
    assert motion.score(stand(0, 0), FAST_MPS) == 1.0
    assert motion.score(stand(1, 0, yaw_deg=170), FAST_MPS) == 0.0
    assert motion.score(stand(60, 0, yaw_deg=170), FAST_MPS) == 1.0


@pytest.mark.parametrize(("moved_m", "score"), [(0.1, 1.0), (2.0, 0.0)])
def test_a_roadside_unit_stays_where_it_is(moved_m: float, score: float) -> None:
    motion = MotionCheck()
    for frame, x_m in enumerate((0.0, moved_m)):
        pose = np.array([x_m, 0, 3, 0, 0, 0])
        result = motion.score(ClaimedPose(frame * PERIOD_NS, pose, 0.0, is_rsu=True), FAST_MPS)
    assert result == score


def test_a_sensor_stays_on_its_vehicle():
    motion = MotionCheck()
    mounts = [np.array([0, 0, 2.4, 0, 0, 0]), np.array([0, 3.0, 2.4, 0, 0, 0])]
    for frame, mount in enumerate(mounts):
        one = stand(frame, 0)
        scored = motion.score(ClaimedPose(one.sim_time_ns, one.pose, 0.05, False, mount), FAST_MPS)
    assert scored == 0.0


@given(tilts=st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 2), min_size=2, max_size=20))
def test_a_sensor_on_a_vehicle_that_pitches_and_rolls_stays_on_it(tilts) -> None:
    motion = MotionCheck()
    vehicle_SE3_sensor = SE3.from_pose([0.3, 0.1, 2.4, 0, 0, 0])
    for frame, (roll_rad, pitch_rad) in enumerate(tilts):
        pose = np.array([10.0 + frame, 5, 1, roll_rad, pitch_rad, 1.57])
        reported = AgentPose(
            frame=frame,
            sim_time_ns=frame * PERIOD_NS,
            agent="cav",
            equipment=Equipment.CAV,
            pose=pose,
            length_m=4.5,
            width_m=1.8,
            height_m=1.5,
            position_std_m=0.05,
        )
        sensor_pose = (SE3.from_pose(pose) @ vehicle_SE3_sensor).as_pose()
        claimed = ClaimedPose.of(frame * PERIOD_NS, reported, sensor_pose)
        assert claimed is not None
        assert motion.score(claimed, FAST_MPS) == 1.0


def test_one_odd_frame_costs_no_trust_and_one_in_four_does():
    trust = TrustScore(0.4)
    for frame in range(200):
        trust.add(0.0 if frame == 100 else 1.0)
        assert trust.is_trusted
    for frame in range(40):
        trust.add(0.0 if frame % 4 == 0 else 1.0)
    assert not trust.is_trusted


def test_trust_comes_back_slowly():
    trust = TrustScore(0.4)
    for _ in range(10):
        trust.add(0.0)
    assert not trust.is_trusted
    for _ in range(10):
        trust.add(1.0)
    assert not trust.is_trusted
    for _ in range(30):
        trust.add(1.0)
    assert trust.is_trusted
