"""Moments at a junction of the user's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cpnet.scenario import load
from learning.own_net import moments_on, observatory_of, seen_by
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
    observatory = observatory_of(scenario(roadside_mounts=mounts, sensor_height_m=4.0), 2)
    moments = list(seen_by(observatory))
    assert observatory.road_map.name == "t_junction"
    assert [moment.frame for moment in moments] == [0, 1]
    for moment in moments:
        east, west, *cavs = moment.shots
        assert (east.agent, west.agent) == ("east", "west")
        assert east.map_SE3_sensor.translation[0] == 20.0
        assert west.map_SE3_sensor.translation[2] > east.map_SE3_sensor.translation[2] + 1.5
        assert cavs
        for cav in cavs:
            assert cav.own is not None
            assert cav.map_SE3_sensor.translation[2] > 3.5
        assert len(moment.boxes)


def test_posts_and_cavs_have_lidars_of_their_own() -> None:
    (moment,) = seen_by(observatory_of(scenario(), 1))
    post, cav = moment.shots[0], moment.shots[1]
    for shot, rings in ((post, 8), (cav, 16)):
        level = np.hypot(shot.points[:, 0], shot.points[:, 1])
        elevation = np.round(np.degrees(np.arctan2(shot.points[:, 2], level)), 1)
        assert len(np.unique(elevation)) == pytest.approx(rings, abs=1)


def test_a_pose_error_of_none_is_none() -> None:
    keys = ("position_std_m", "height_std_m", "heading_std_deg", "tilt_std_deg")
    exact = {f"pose__{key}": 0 for key in keys}
    (moment,) = seen_by(observatory_of(scenario(**exact), 1))
    for shot in moment.shots[1:]:
        place = shot.map_SE3_sensor.translation[:2]
        assert np.hypot(*(moment.boxes[shot.own, :2] - place)) < 0.1


def test_a_net_of_the_users_is_seen_alone_and_in_a_scenario(tmp_path: Path) -> None:
    net = write_net(tmp_path)
    road_map, moments = moments_on(net, "J", 1, seed=1)
    assert road_map.signal.tls == "J"
    assert len(moments) == 1
    assert len(moments[0].shots) >= 2
    own = observatory_of(scenario(traffic__net=str(net), traffic__tls="J"), 1)
    (moment,) = seen_by(own)
    assert own.road_map.signal == road_map.signal
    assert moment.shots[0].agent == "rsu-0"


def test_a_junction_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        moments_on(tmp_path / "none.net.xml", None, 1, 1)
    with pytest.raises(ConfigError, match="does not exist"):
        observatory_of(scenario(traffic__net=str(tmp_path / "none.net.xml")), 1)
    with pytest.raises(ConfigError, match="must be null"):
        observatory_of(scenario() | {"recording": "somewhere"}, 1)
