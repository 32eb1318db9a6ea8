"""The options of sensors."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from protocol.codec import decode, encode_scan
from protocol.scans import RangeScan
from sensing.config import LidarConfig, Mount, PoseErrorConfig, SceneConfig, UploadConfig
from sensing.sensor_models import SENSOR_MODELS


def test_the_default_pattern_is_64_rings_of_1800() -> None:
    pattern = LidarConfig().pattern
    assert (pattern.channels, pattern.columns) == (64, 1800)


@pytest.mark.parametrize("wrong", [{"points_per_second": 10}, {"channels": 1}])
def test_a_pattern_of_too_few_or_too_many_columns_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValidationError, match="allowed are 1 to 8192"):
        LidarConfig(**wrong)


def test_a_field_of_view_upside_down_is_refused() -> None:
    with pytest.raises(ValidationError, match="lies above upper_fov"):
        LidarConfig(upper_fov=-30)


@pytest.mark.parametrize(
    "section", [LidarConfig, Mount, PoseErrorConfig, SceneConfig, UploadConfig]
)
def test_every_option_is_described_and_survives_json(section: type[LidarConfig]) -> None:
    assert all(field.description for field in section.model_fields.values())
    assert section.model_validate(section().model_dump(mode="json")) == section()


def test_a_mount_whose_name_cannot_stand_in_a_topic_is_refused() -> None:
    with pytest.raises(ValidationError, match="pattern"):
        Mount(id="a/b")


def test_a_sparse_lidar_has_a_quarter_of_the_rays_unless_told_otherwise() -> None:
    full, sparse = LidarConfig(), LidarConfig(model="sparse")
    assert (sparse.channels, sparse.columns) == (full.channels // 4, full.columns)
    assert LidarConfig.model_validate(sparse.model_dump()) == sparse
    assert LidarConfig(model="sparse", channels=32, points_per_second=576_000).channels == 32


@pytest.mark.parametrize("name", SENSOR_MODELS)
def test_a_real_lidar_has_its_own_rings_and_they_are_sent(name: str) -> None:
    config, model = LidarConfig(model=name), SENSOR_MODELS[name]
    assert LidarConfig.model_validate(config.model_dump(mode="json")) == config
    pattern = config.pattern
    assert (pattern.channels, pattern.columns) == (len(model.elevations_deg), model.columns)
    sent = np.degrees(np.arcsin(pattern.directions[:, 0, 2]))
    assert sent == pytest.approx(np.array(model.elevations_deg), abs=0.006)
    range_m = np.full((pattern.channels, pattern.columns), 20, np.float32)
    scan = RangeScan(pattern, range_m, np.zeros_like(range_m))
    back = decode(encode_scan(scan, 0.02))
    assert np.linalg.norm(back.points - scan.cloud().points, axis=1).max() <= 0.02


@pytest.mark.parametrize("key", [{"channels": 32}, {"upper_fov": 5}, {"lower_fov": -30}])
def test_rings_that_a_real_lidar_does_not_have_are_refused(key: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="a hdl-64e has .*or choose model full"):
        LidarConfig(model="hdl-64e", **key)
