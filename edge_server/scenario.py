"""What the edge reads from a scenario beside its own section: agents, mounts, links."""

from __future__ import annotations

from typing import Any

import numpy as np

from edge_server.completion import VirtualDeadline
from edge_server.config import EdgeConfig
from perception.arrays import Floats
from protocol.roadmap import RoadMap
from sensing.config import Mount, UploadConfig
from sensing.link_config import LinkConfig
from sensing.upload_policies import policy_of


def has_lidars(scenario: dict[str, Any]) -> bool:
    """Whether a scenario has agents that send what their LiDAR measures, present yet or not.

    The scenario decides, not what has arrived: a scan that never arrives is not one that does not
    exist.
    """
    upload = UploadConfig.model_validate(scenario.get("upload", {}))
    is_there = {
        "roadside": bool(scenario["roadside_mounts"]),
        "vehicle": bool(scenario.get("recording")) or scenario["traffic"]["cav_rate"] > 0,
    }
    return any(
        is_there[kind] and policy_of(upload.of(kind).policy).sends != "nothing"
        for kind in ("roadside", "vehicle")
    )


def mounts_of(scenario: dict[str, Any], road_map: RoadMap) -> dict[str, Floats]:
    """Returns by agent x, y and yaw (3,) of the scenario's roadside units, map frame."""
    mounts = [Mount.model_validate(mount) for mount in scenario["roadside_mounts"]]
    x_m, y_m = road_map.centre[:2]
    return {m.id: np.array([x_m + m.x_m, y_m + m.y_m, np.radians(m.yaw_deg)]) for m in mounts}


def virtual_deadline(scenario: dict[str, Any], config: EdgeConfig) -> VirtualDeadline | None:
    """Returns the deadline on virtual links, in simulated time; None where links are real."""
    link = LinkConfig.of(scenario)
    if link.channel(scenario["mode"]) != "virtual":
        return None
    return VirtualDeadline(round(config.deadline_ms * 1e6), round(link.edge_compute_ms * 1e6))
