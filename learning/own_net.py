"""Labelled moments on a net of the user's, with the default scene and LiDAR."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import numpy as np

from learning.dataset import moment_of
from learning.moments import Moment
from learning.observe import Observatory
from learning.sites import draw_site
from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sensing.config import LidarConfig, SceneConfig
from sim_host.config import TrafficConfig


def moments_on(net: Path, tls: str | None, moments: int, seed: int) -> tuple[RoadMap, list[Moment]]:
    """Returns the net's road map and its moments, some seconds apart, with generated demand.

    Raises:
        ConfigError: the net cannot be read or has no such signal.
    """
    if not net.is_file():
        raise ConfigError(f"--net {net}: there is no such file")
    traffic = TrafficConfig(
        net=str(net.resolve()), tls=tls, step_s=0.5, cav_rate=0.0, reach_m=300.0
    )
    update = {"traffic": traffic, "scene": SceneConfig(), "lidar": LidarConfig()}
    site = draw_site(seed, 0).model_copy(update=update)
    observatory = Observatory(site, moments)
    made = []
    for _, group in groupby(observatory.scans(), lambda scan: scan.row.frame):
        scans = list(group)
        clouds = [np.ascontiguousarray(scan.points[:, :3]) for scan in scans]
        made.append(moment_of([s.row for s in scans], [s.labels for s in scans], clouds))
    return observatory.road_map, made
