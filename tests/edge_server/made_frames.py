"""A frame of a roadside unit that sees a road with cars, and of a CAV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from edge_server.frame import (
    Chunk,
    Frame,
)
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment

CLIMB = 0.035
CARS = [(-90, 1.75), (-40, 1.75), (-40, -1.75), (-33, 1.75), (-15, -1.75), (40, 1.75), (80, -1.75)]
ROADSIDE = np.array([0, 0, 3.0, 0, 0, 0.7])


def frame_of(
    car_shell: Callable[..., Any], ground: Callable[..., Any], *, seed: int = 1, number: int = 0
) -> Frame:
    """What a post in the junction sees of a climbing road with cars, and a CAV that it does not."""
    rng = np.random.default_rng(seed)
    slope = -np.arctan(CLIMB)
    cars = [car_shell([x, y, CLIMB * x, 0, slope, 0], (0.0, 0.0), rng) for x, y in CARS]
    points = np.concatenate([ground(rng, climb=CLIMB), *cars])
    in_sensor = SE3.from_pose(ROADSIDE).inverse().apply(points).astype(np.float32)
    own = AgentPose(
        frame=number,
        sim_time_ns=7,
        agent="cav",
        equipment=Equipment.CAV,
        pose=np.array([-60, -1.75, -60 * CLIMB, 0, slope, 0]),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    )
    scan = Chunk(number, 7, "rsu-0", 0, 1, ROADSIDE, in_sensor, 0)
    return Frame(number, 7, ["cav", "rsu-0"], [own], [scan], True, 0, 0)
