"""Errors of agents' own pose estimates."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.geometry import SE3
from protocol.messages import Equipment
from sensing.config import PoseErrorConfig
from sensing.noise import stream
from sensing.pose import (
    PoseEstimator,
    clock_error_s,
    estimated_pose,
    installed_pose,
    position_std_m,
)
from sensing.world_view import WorldView

TRUE = np.array([10.0, -3.0, 0.5, 0.02, -0.03, 3.1])


@pytest.mark.parametrize(("equipment", "xy_m"), [(Equipment.CAV, 0.05), (Equipment.CV, 1.5)])
def test_errors_have_the_configured_size(equipment: Equipment, xy_m: float) -> None:
    config = PoseErrorConfig()
    found = np.array([estimated_pose(TRUE, config, equipment, stream(1, k)) for k in range(2000)])
    assert (found[:, :2] - TRUE[:2]).std(axis=0) == pytest.approx(xy_m, rel=0.1)
    assert found[:, :2].mean(axis=0) == pytest.approx(TRUE[:2], abs=xy_m / 10)
    assert np.abs(found[:, 5]).max() <= np.pi
    assert position_std_m(config, equipment) == xy_m


def test_a_cv_does_not_know_its_tilt() -> None:
    pose = estimated_pose(TRUE, PoseErrorConfig(), Equipment.CV, stream(1))
    assert pose[3:5].tolist() == [0.0, 0.0]


def test_a_vehicle_without_equipment_has_nothing_to_say() -> None:
    with pytest.raises(ValueError, match="no pose"):
        estimated_pose(TRUE, PoseErrorConfig(), Equipment.NONE, stream(1))


def test_without_errors_the_truth_is_believed() -> None:
    config = PoseErrorConfig(position_std_m=0, height_std_m=0, heading_std_deg=0, tilt_std_deg=0)
    assert estimated_pose(TRUE, config, Equipment.CAV, stream(1)) == pytest.approx(TRUE)


NO_NOISE = {"position_std_m": 0, "height_std_m": 0, "heading_std_deg": 0, "tilt_std_deg": 0}
DRIFTING = PoseErrorConfig(
    bias_position_std_m=0.3, bias_heading_std_deg=0.5, drift_position_std_m=0.2, drift_time_s=10
)
SECOND_NS = 1_000_000_000


def test_slow_errors_follow_from_seed_agent_and_time_alone() -> None:
    one = PoseEstimator(DRIFTING, 3, "a", Equipment.CAV)
    poses = [one.estimate(TRUE, k, k * SECOND_NS // 10) for k in range(50)]
    restarted = PoseEstimator(DRIFTING, 3, "a", Equipment.CAV)
    assert restarted.estimate(TRUE, 49, 49 * SECOND_NS // 10).tolist() == poses[49].tolist()
    other = PoseEstimator(DRIFTING, 3, "b", Equipment.CAV).slow_error(0)
    assert (one.slow_error(0)[[0, 1, 5]] != other[[0, 1, 5]]).all()


def test_bias_and_drift_have_the_configured_size_and_correlation() -> None:
    agents = [PoseEstimator(DRIFTING, 1, f"v{n}", Equipment.CAV) for n in range(1500)]
    now, later, much_later = (
        np.array([agent.slow_error(at * SECOND_NS) for agent in agents]) for at in (100, 110, 400)
    )
    assert now[:, :2].std(axis=0) == pytest.approx(np.hypot(0.3, 0.2), rel=0.08)
    assert np.degrees(now[:, 5].std()) == pytest.approx(0.5, rel=0.08)
    assert now[:, 2:5].any() == np.False_
    drift = now - much_later  # without the bias: two independent drifts
    assert drift[:, :2].std(axis=0) == pytest.approx(0.2 * np.sqrt(2), rel=0.08)
    step = now - later  # one correlation time apart: 1 - 1/e of the variance is new
    assert step[:, :2].var(axis=0) == pytest.approx(2 * 0.2**2 * (1 - np.exp(-1)), rel=0.15)


def test_an_agent_reports_all_that_its_position_may_be_off() -> None:
    assert position_std_m(DRIFTING, Equipment.CAV) == pytest.approx(
        np.sqrt(0.05**2 + 0.3**2 + 0.2**2)
    )
    assert position_std_m(PoseErrorConfig(), Equipment.CAV) == 0.05


def test_without_slow_errors_the_noise_is_all() -> None:
    estimator = PoseEstimator(PoseErrorConfig(), 1, "a", Equipment.CAV)
    noisy = estimated_pose(TRUE, PoseErrorConfig(), Equipment.CAV, stream(1, "pose", "a", 7))
    assert estimator.estimate(TRUE, 7, SECOND_NS).tolist() == noisy.tolist()


def test_a_roadside_unit_stands_off_its_survey() -> None:
    surveyed = SE3.from_pose([5, 6, 3, 0, 0, 1])
    assert installed_pose(surveyed, PoseErrorConfig(), 1, "rsu-0") is surveyed
    config = PoseErrorConfig(mount_position_std_m=0.05, mount_heading_std_deg=0.2)
    off = np.array(
        [
            installed_pose(surveyed, config, seed, "rsu-0").as_pose() - surveyed.as_pose()
            for seed in range(500)
        ]
    )
    assert off[:, :3].std(axis=0) == pytest.approx(0.05, rel=0.15)
    assert np.degrees(off[:, 5].std()) == pytest.approx(0.2, rel=0.15)
    assert np.abs(off[:, 3:5]).max() < 1e-12


def test_a_late_clock_shows_the_world_later() -> None:
    assert clock_error_s(PoseErrorConfig(), 1, "a") == 0.0
    late_s = [clock_error_s(PoseErrorConfig(clock_std_s=0.02), s, "a") for s in range(500)]
    assert np.std(late_s) == pytest.approx(0.02, rel=0.15)
    poses = np.array([[0.0, 0, 0, 0, 0, np.pi / 2], [9.0, 0, 0, 0, -0.1, 0]])
    view = WorldView(3, 300, ["a", "b"], ["car"] * 2, poses, np.array([10, 20], np.float32), {})
    later = view.later(0.02)
    assert later.poses[0, :3] == pytest.approx([0, 0.2, 0])
    assert later.poses[1, :3] == pytest.approx([9 + 0.4 * np.cos(0.1), 0, 0.4 * np.sin(0.1)])
    assert (later.frame, later.sim_time_ns, view.later(0.0)) == (3, 300, view)
