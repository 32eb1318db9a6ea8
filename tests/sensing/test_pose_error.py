"""What agents believe about their pose."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.messages import Equipment
from sensing.config import PoseErrorConfig
from sensing.noise import stream
from sensing.pose import estimated_pose, position_std_m

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
