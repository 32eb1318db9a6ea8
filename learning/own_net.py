"""Labelled moments at a junction of the user's: of a net alone, or of a whole scenario."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from learning.dataset import moment_of
from learning.moments import Moment
from learning.observe import Observatory
from learning.sensors import Sensors
from learning.sites import draw_site
from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sensing.config import LidarConfig, Mount, PoseErrorConfig, SceneConfig
from sim_host.config import TrafficConfig
from sim_host.setup import traffic_config

_WARM_UP_S = 60.0  # at least; then vehicles have come from all sides


def moments_on(net: Path, tls: str | None, moments: int, seed: int) -> tuple[RoadMap, list[Moment]]:
    """Returns the net's road map and its moments, some seconds apart, with generated demand.

    Scene and LiDAR are the default ones.

    Raises:
        ConfigError: the net cannot be read or has no such signal.
    """
    if not net.is_file():
        raise ConfigError(f"--net {net}: there is no such file")
    traffic = TrafficConfig(
        net=str(net.resolve()), tls=tls, step_s=0.5, cav_rate=0.0, reach_m=300.0
    )
    update = {
        "junction": None,
        "traffic": traffic,
        "scene": SceneConfig(),
        "lidar": LidarConfig(),
    }
    observatory = Observatory(draw_site(seed, 0).model_copy(update=update), moments)
    return observatory.road_map, list(seen_by(observatory))


def observatory_of(scenario: dict[str, Any], moments: int) -> Observatory:
    """Returns the junction of a scenario whose every key has its value, with its sensors.

    Traffic runs on the fixed plan. Posts, LiDARs, pose errors and seed are the scenario's; who
    carries a LiDAR is drawn anew at every moment, up to five vehicles near the junction.

    Raises:
        ConfigError: its files cannot be read, or it plays a recording.
    """
    if scenario.get("recording") is not None:
        raise ConfigError(
            f"recording is {scenario['recording']}: moments are made of simulated traffic, must be "
            "null"
        )
    traffic, lidar = traffic_config(scenario), scenario["lidar"]
    vehicle, height_m = LidarConfig.model_validate(lidar["vehicle"]), scenario["sensor_height_m"]
    sensors = Sensors(
        roadside=LidarConfig.model_validate(lidar["roadside"]),
        vehicle=vehicle,
        mounts=tuple(Mount.model_validate(one) for one in scenario["roadside_mounts"]),
        roof_m=(height_m, height_m),
        pose=PoseErrorConfig.model_validate(scenario["pose"]),
    )
    update = {
        "seed": scenario["seed"],
        "junction": None,
        "traffic": traffic,
        "scene": SceneConfig.model_validate(scenario["scene"]),
        "lidar": vehicle,
        "warm_up_s": max(traffic.warmup_s, _WARM_UP_S),
    }
    site = draw_site(scenario["seed"], 0).model_copy(update=update)
    return Observatory(site, moments, sensors)


def seen_by(observatory: Observatory) -> Iterator[Moment]:
    """Yields the moments at which somebody scanned."""
    for _, group in groupby(observatory.scans(), lambda scan: scan.row.frame):
        scans = list(group)
        clouds = [np.ascontiguousarray(scan.points[:, :3]) for scan in scans]
        yield moment_of([s.row for s in scans], [s.labels for s in scans], clouds)
