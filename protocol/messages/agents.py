"""What agents say: who they are, where they are, what they see."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from protocol.arrays import Bytes, Floats32
from protocol.messages.base import Message, check_lengths
from protocol.messages.fields import (
    AgentId,
    Boxes,
    Count,
    Equipment,
    FrameNumber,
    Id,
    Ids,
    Pose,
    TimeNs,
)


class Roster(Message):
    """Which agents a process speaks for in a frame, and which of them send a scan."""

    kind: ClassVar[int] = 8
    frame: FrameNumber
    process: Id
    agents: Ids
    scanning: Ids


class AgentPose(Message):
    """Where an agent believes it is (footprint centre on the ground), and how large it is."""

    kind: ClassVar[int] = 9
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: AgentId
    equipment: Equipment
    pose: Pose
    length_m: float = Field(ge=0, le=60)
    width_m: float = Field(ge=0, le=10)
    height_m: float = Field(ge=0, le=10)
    position_std_m: float = Field(ge=0, le=1000)
    arrival_sim_ns: TimeNs | None = None


class Scan(Message):
    """One chunk of an encoded scan. `sensor_pose` is `map_SE3_sensor` as the agent believes it.

    Chunks are numbered from 0 and sent in this order. `plan_frame` is the frame of the plan that
    the chunks were cut by, -1 for none. `ground_free` says that the agent has taken away what
    belongs to the ground and to the static scene.
    """

    kind: ClassVar[int] = 10
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: AgentId
    chunk: int = Field(ge=0)
    chunks: int = Field(ge=1, le=64)
    points: Count
    plan_frame: int = Field(-1, ge=-1, lt=1 << 40)
    ground_free: bool = False
    sensor_pose: Pose
    sense_start_ns: TimeNs
    sense_end_ns: TimeNs
    encode_end_ns: TimeNs
    arrival_sim_ns: TimeNs | None = None
    payload: Bytes

    @model_validator(mode="after")
    def _is_one_of_its_chunks(self) -> Self:
        if self.chunk >= self.chunks:
            raise ValueError(f"chunk {self.chunk} of {self.chunks}: counting begins with 0")
        return self


class Objects(Message):
    """What an agent that detects for itself found, in the place of a scan.

    Boxes are as in `Detections`, in the map frame as the agent believes it.
    """

    kind: ClassVar[int] = 16
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: AgentId
    boxes: Boxes
    scores: Floats32
    sense_start_ns: TimeNs
    sense_end_ns: TimeNs
    detect_end_ns: TimeNs
    arrival_sim_ns: TimeNs | None = None

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "boxes", "scores")
        return self
