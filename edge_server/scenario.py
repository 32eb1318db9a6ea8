"""Settings of other scenario sections that the edge needs: agents, mounts, links."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from edge_server.completion import VirtualDeadline
from edge_server.config import EdgeConfig
from perception.arrays import Floats
from protocol.roadmap import RoadMap
from sensing.config import Mount, UploadConfig
from sensing.link_config import LinkConfig
from sensing.pose import mount_place
from sensing.upload_policies import policy_of


def has_lidars(scenario: dict[str, Any], mounts: Sequence[Any]) -> bool:
    """Whether any agent sends LiDAR data, present yet or not; `mounts` are the region's.

    The scenario decides, not what has arrived: a missing scan may have been lost.
    """
    upload = UploadConfig.model_validate(scenario.get("upload", {}))
    is_there = {
        "roadside": bool(mounts),
        "vehicle": bool(scenario.get("recording")) or scenario["traffic"]["cav_rate"] > 0,
    }
    return any(
        is_there[kind] and policy_of(upload.of(kind).policy).sends != "nothing"
        for kind in ("roadside", "vehicle")
    )


def places_of(mounts: Sequence[Any], road_map: RoadMap) -> dict[str, Floats]:
    """Returns by agent x, y and yaw (3,) of roadside units, map frame."""
    units = [Mount.model_validate(mount) for mount in mounts]
    return {
        unit.id: np.array([*mount_place(unit, road_map), np.radians(unit.yaw_deg)])
        for unit in units
    }


def virtual_deadline(scenario: dict[str, Any], config: EdgeConfig) -> VirtualDeadline | None:
    """Returns the deadline on virtual links, in simulated time; None where links are real."""
    link = LinkConfig.of(scenario)
    if link.channel(scenario["mode"]) != "virtual":
        return None
    return VirtualDeadline(round(config.deadline_ms * 1e6), round(link.edge_compute_ms * 1e6))
