"""Moments at a junction of the user's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cpnet.scenario import load
from learning.scanner import samples_of, samples_on, scanner_of
from protocol.errors import ConfigError
from sim_host.junctions import write_net


def scenario(**keys: Any) -> dict[str, Any]:
    """A scenario whose posts have 8 rings and whose CAVs have 16."""
    set_ = {f"lidar.{kind}.points_per_second": 72_000 for kind in ("roadside", "vehicle")}
    set_ |= {"lidar.roadside.channels": 8, "lidar.vehicle.channels": 16, "traffic.step_s": 0.5}
    overrides = set_ | {"frame_period_s": 0.5} | {k.replace("__", "."): v for k, v in keys.items()}
    return load("t_junction", overrides).model_dump(mode="json")


def test_the_built_in_junction_is_seen_by_the_scenarios_sensors() -> None:
    mounts = [{"id": "east", "x_m": 20.0}, {"id": "west", "x_m": -20.0, "height_m": 5.0}]
    scanner = scanner_of(scenario(roadside_mounts=mounts, sensor_height_m=4.0), 2)
    samples = list(samples_of(scanner))
    assert scanner.road_map.name == "t_junction"
    assert [sample.frame for sample in samples] == [0, 1]
    for sample in samples:
        east, west, *cavs = sample.scans
        assert (east.agent, west.agent) == ("east", "west")
        assert east.map_SE3_sensor.translation[0] == 20.0
        assert west.map_SE3_sensor.translation[2] > east.map_SE3_sensor.translation[2] + 1.5
        assert cavs
        for cav in cavs:
            assert cav.own is not None
            assert cav.map_SE3_sensor.translation[2] > 3.5
        assert len(sample.boxes)


def test_posts_and_cavs_have_lidars_of_their_own() -> None:
    (sample,) = samples_of(scanner_of(scenario(), 1))
    post, cav = sample.scans[0], sample.scans[1]
    for scan, rings in ((post, 8), (cav, 16)):
        level = np.hypot(scan.points[:, 0], scan.points[:, 1])
        elevation = np.round(np.degrees(np.arctan2(scan.points[:, 2], level)), 1)
        assert len(np.unique(elevation)) == pytest.approx(rings, abs=1)


def test_a_pose_error_of_none_is_none() -> None:
    keys = ("position_std_m", "height_std_m", "heading_std_deg", "tilt_std_deg")
    exact = {f"pose__{key}": 0 for key in keys}
    (sample,) = samples_of(scanner_of(scenario(**exact), 1))
    for scan in sample.scans[1:]:
        place = scan.map_SE3_sensor.translation[:2]
        assert np.hypot(*(sample.boxes[scan.own, :2] - place)) < 0.1


def test_a_net_of_the_users_is_seen_alone_and_in_a_scenario(tmp_path: Path) -> None:
    net = write_net(tmp_path)
    road_map, samples = samples_on(net, "J", 1, seed=1)
    assert road_map.intersections[0].signal.tls == "J"
    assert len(samples) == 1
    assert len(samples[0].scans) >= 2
    own = scanner_of(scenario(traffic__net=str(net), junctions=["J"]), 1)
    (sample,) = samples_of(own)
    assert own.road_map.intersections[0].signal == road_map.intersections[0].signal
    assert sample.scans[0].agent == "rsu-0"


def test_a_junction_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        samples_on(tmp_path / "none.net.xml", None, 1, 1)
    with pytest.raises(ConfigError, match="does not exist"):
        scanner_of(scenario(traffic__net=str(tmp_path / "none.net.xml")), 1)
    with pytest.raises(ConfigError, match="must be null"):
        scanner_of(scenario() | {"recording": "somewhere"}, 1)
