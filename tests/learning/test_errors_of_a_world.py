"""What a world's errors of clocks and maps do to data sets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cpnet.scenario import load
from learning.scanner import JunctionScanner, scanner_of

FEW_BEAMS = {
    f"lidar.{kind}.{key}": value
    for kind in ("roadside", "vehicle")
    for key, value in (("channels", 8), ("points_per_second", 72_000))
}
FEW_BEAMS |= {"traffic.step_s": 0.5, "frame_period_s": 0.5}


def scanned(**keys: Any) -> JunctionScanner:
    overrides = FEW_BEAMS | {key.replace("__", "."): value for key, value in keys.items()}
    return scanner_of(load("t_junction", overrides).model_dump(mode="json"), 4)


@pytest.fixture(scope="module")
def exact() -> JunctionScanner:
    return scanned()


def test_a_clock_that_is_off_moves_what_is_scanned_and_not_the_labels(exact) -> None:
    off = scanned(pose__clock_std_s=0.5)
    pairs = list(zip(exact.scans(), off.scans(), strict=True))
    post, late = pairs[0]
    assert [one.box for one in post.labels] == [one.box for one in late.labels]
    assert post.points.shape != late.points.shape or not np.array_equal(post.points, late.points)
    assert any(
        not np.allclose(cav.row.map_SE3_sensor.true, moved.row.map_SE3_sensor.true)
        for cav, moved in pairs
        if cav.row.kind == "vehicle"
    )


def test_the_map_of_a_data_set_is_off_as_the_edges_are_and_the_scans_are_the_same(exact) -> None:
    off = scanned(scene__map_height_std_m=2.0)
    true, believed = (one.road_map.model_dump_json() for one in (exact, off))
    assert true != believed
    for here, there in zip(exact.scans(), off.scans(), strict=True):
        assert np.array_equal(here.points, there.points)
