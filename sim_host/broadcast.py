"""What the sim role says, as messages."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from protocol.messages import Equipment, Tick, Truth
from sim_host.fleet import Fleet
from sim_host.world import Bodies


def connected(bodies: Bodies) -> dict[str, Equipment]:
    """Returns the vehicles that carry something, and what."""
    return {
        name: Equipment(int(kind))
        for name, kind in zip(bodies.ids, bodies.equipment, strict=True)
        if kind != Equipment.NONE
    }


def tick_of(frame: int, sim_time_ns: int, bodies: Bodies, fleet: Fleet) -> Tick:
    """Returns the tick of a frame; vehicles without radio have no host."""
    processes = fleet.processes
    hosts: Mapping[str, str] = fleet.assign(connected(bodies))
    number = {name: index for index, name in enumerate(processes)}
    return Tick(
        frame=frame,
        sim_time_ns=sim_time_ns,
        processes=processes,
        ids=bodies.ids,
        types=bodies.types,
        poses=bodies.poses,
        speeds_mps=bodies.speeds_mps,
        equipment=bodies.equipment,
        hosts=np.array([number[hosts[n]] if n in hosts else -1 for n in bodies.ids], np.int32),
    )


def truth_of(frame: int, sim_time_ns: int, bodies: Bodies) -> Truth:
    """Returns the truth of a frame: the tick's poses, with lanes and places along them."""
    return Truth(
        frame=frame,
        sim_time_ns=sim_time_ns,
        ids=bodies.ids,
        types=bodies.types,
        lanes=bodies.lanes,
        poses=bodies.poses,
        speeds_mps=bodies.speeds_mps,
        lane_positions_m=bodies.lane_positions_m,
        equipment=bodies.equipment,
    )
