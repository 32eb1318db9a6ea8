"""What the edge knows of one frame, decoded, in an order that does not depend on arrival."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge_server.views import View
from perception.arrays import Floats, Floats32
from perception.roadway import Placed
from protocol.codec import decode
from protocol.messages import AgentPose, Objects, Scan


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """One decoded chunk of a scan: points (N, 3) in the sensor frame, until they are placed.

    `sensor_pose` (6,) is `map_SE3_sensor` as the agent believes it. For `plan_frame` and
    `ground_free` see `protocol.messages.Scan`; `size_bytes` is that of the payload, `returns` how
    many points it had. One that `is_spoilt` came, but nobody can tell what it showed.
    """

    frame: int
    sim_time_ns: int
    agent: str
    index: int
    chunk_count: int
    sensor_pose: Floats
    points: Floats32
    received_ns: int
    decode_start_ns: int
    decode_end_ns: int
    plan_frame: int = -1
    ground_free: bool = False
    arrival_sim_ns: int | None = None
    size_bytes: int = 0
    placed: Placed | None = None
    view: View | None = None
    placed_ns: int = 0
    returns: int = 0
    is_undecodable: bool = False

    def with_placed(self, placed: Placed, view: View | None) -> Chunk:
        """Returns the piece with its points on the road, map frame, and when that was done.

        `view` is what they show to be taken and to be free, if anybody will ask.

        All others are let go: the next scan is decoded into memory that is still near.
        """
        nothing = np.zeros((0, 3), np.float32)
        now_ns = time.monotonic_ns()
        return replace(self, points=nothing, placed=placed, view=view, placed_ns=now_ns)


@dataclass(frozen=True, slots=True, eq=False)
class AgentDetections:
    """Boxes that an agent found for itself, and when they came."""

    objects: Objects
    received_ns: int

    @property
    def agent(self) -> str:
        """Whose they are."""
        return self.objects.agent

    @property
    def arrival_sim_ns(self) -> int | None:
        """When they came over a virtual link."""
        return self.objects.arrival_sim_ns


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A frame as far as it came. `complete` says whether all that is needed is there.

    `agents`, `poses` and `found` are sorted by agent, `pieces` by agent and chunk. The first part
    came at `first_ns`; waiting ended at `ready_ns`. `scanning` are the agents, sorted, that
    announced a scan, be it here or not. `delay_sim_ns` is known where links are virtual.
    """

    frame: int
    sim_time_ns: int
    agents: list[str]
    poses: list[AgentPose]
    chunks: list[Chunk]
    complete: bool
    first_ns: int
    ready_ns: int
    scanning: Sequence[str] = ()
    found: Sequence[AgentDetections] = ()
    delay_sim_ns: int | None = None


def decode_chunk(scan: Scan, received_ns: int) -> Chunk:
    """Decodes a chunk.

    Raises:
        CodecError: the payload is not a scan.
    """
    start_ns = time.monotonic_ns()
    points = np.ascontiguousarray(decode(scan.payload).points, np.float32)
    return _chunk(scan, points, received_ns, start_ns)


def undecodable_scan(scan: Scan, received_ns: int) -> Chunk:
    """Returns a chunk without points in place of one that does not decode: it did come."""
    points = np.zeros((0, 3), np.float32)
    return replace(_chunk(scan, points, received_ns, time.monotonic_ns()), is_undecodable=True)


def _chunk(scan: Scan, points: Floats32, received_ns: int, start_ns: int) -> Chunk:
    return Chunk(
        frame=scan.frame,
        sim_time_ns=scan.sim_time_ns,
        agent=scan.agent,
        index=scan.chunk,
        chunk_count=scan.chunks,
        sensor_pose=scan.sensor_pose,
        points=points,
        received_ns=received_ns,
        decode_start_ns=start_ns,
        decode_end_ns=time.monotonic_ns(),
        plan_frame=scan.plan_frame,
        ground_free=scan.ground_free,
        arrival_sim_ns=scan.arrival_sim_ns,
        size_bytes=scan.payload.size,
        returns=len(points),
    )
