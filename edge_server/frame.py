"""What the edge knows of one frame, decoded, in an order that does not depend on arrival."""

from __future__ import annotations

from dataclasses import dataclass

from edge_server.arrays import Floats, Floats32
from protocol.codec import decode
from protocol.messages import AgentPose, Scan


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One decoded chunk of a scan: points (N, 3) in the sensor frame.

    `sensor_pose` (6,) is `map_SE3_sensor` as the agent believes it.
    """

    agent: str
    chunk: int
    sensor_pose: Floats
    points: Floats32
    received_ns: int
    decode_start_ns: int
    decode_end_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A frame as far as it came. `complete` says whether all that was promised is there.

    `agents` and `poses` are sorted by agent, `pieces` by agent and chunk.
    """

    frame: int
    sim_time_ns: int
    agents: list[str]
    poses: list[AgentPose]
    pieces: list[Piece]
    complete: bool
    first_ns: int
    ready_ns: int


def open_scan(scan: Scan) -> Floats32:
    """Decodes a chunk's points (N, 3), sensor frame.

    Raises:
        CodecError: the payload is not a scan.
    """
    return decode(scan.payload).points
