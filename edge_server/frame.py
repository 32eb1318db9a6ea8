"""What the edge knows of one frame, decoded, in an order that does not depend on arrival."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from edge_server.arrays import Floats, Floats32
from edge_server.roadway import Placed
from protocol.codec import decode
from protocol.messages import AgentPose, Scan


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One decoded chunk of a scan: points (N, 3) in the sensor frame.

    `sensor_pose` (6,) is `map_SE3_sensor` as the agent believes it.
    """

    frame: int
    sim_time_ns: int
    agent: str
    chunk: int
    chunks: int
    sensor_pose: Floats
    points: Floats32
    received_ns: int
    decode_start_ns: int
    decode_end_ns: int
    arrival_sim_ns: int | None = None
    placed: Placed | None = None
    placed_ns: int = 0

    def with_placed(self, placed: Placed) -> Piece:
        """Returns the piece with its points on the road, map frame, and when that was done."""
        return replace(self, placed=placed, placed_ns=time.monotonic_ns())


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A frame as far as it came. `complete` says whether all that was promised is there.

    `agents` and `poses` are sorted by agent, `pieces` by agent and chunk. The first part came at
    `first_ns`; waiting ended at `ready_ns`. `delay_sim_ns` is known where links are virtual.
    """

    frame: int
    sim_time_ns: int
    agents: list[str]
    poses: list[AgentPose]
    pieces: list[Piece]
    complete: bool
    first_ns: int
    ready_ns: int
    delay_sim_ns: int | None = None


def open_scan(scan: Scan, received_ns: int) -> Piece:
    """Decodes a chunk.

    Raises:
        CodecError: the payload is not a scan.
    """
    start_ns = time.monotonic_ns()
    points = np.ascontiguousarray(decode(scan.payload).points, np.float32)
    return _piece(scan, points, received_ns, start_ns)


def spoilt_scan(scan: Scan, received_ns: int) -> Piece:
    """Returns a chunk without points in place of one that does not decode: it did come."""
    points = np.zeros((0, 3), np.float32)
    return _piece(scan, points, received_ns, time.monotonic_ns())


def _piece(scan: Scan, points: Floats32, received_ns: int, start_ns: int) -> Piece:
    return Piece(
        frame=scan.frame,
        sim_time_ns=scan.sim_time_ns,
        agent=scan.agent,
        chunk=scan.chunk,
        chunks=scan.chunks,
        sensor_pose=scan.sensor_pose,
        points=points,
        received_ns=received_ns,
        decode_start_ns=start_ns,
        decode_end_ns=time.monotonic_ns(),
        arrival_sim_ns=scan.arrival_sim_ns,
    )
