"""What the edge says: vehicles, lane counts, and to each agent what it shall send."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from protocol.arrays import BoxRows, Floats32
from protocol.messages.base import Message, check_lengths
from protocol.messages.fields import (
    BOUNDED,
    Borders,
    Count,
    DelayNs,
    FrameNumber,
    Id,
    Ids,
    NetId,
    Sites,
    Texts,
    TimeNs,
)


class Detections(Message):
    """Vehicles of a frame.

    Boxes are x, y, z of the centre, length, width, height in m and yaw in rad. `distances_m` is
    the way to the stop bar, negative behind it. `sources` is "lidar" or the agent whose own pose
    it is. `lanes` holds an empty string where a box is on no lane.
    """

    kind: ClassVar[int] = 11
    frame: FrameNumber
    sim_time_ns: TimeNs
    agents: Ids
    boxes: BoxRows
    scores: Floats32
    lanes: Texts
    distances_m: Floats32
    sources: Texts

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "boxes", "scores", "lanes", "distances_m", "sources")
        return self


Counts = Annotated[dict[NetId, Count], *BOUNDED]
Shares = Annotated[dict[NetId, Annotated[float, Field(ge=0, le=1)]], *BOUNDED]


class LaneCounts(Message):
    """Vehicles per lane: within the reach upstream of the stop bar and downstream behind it.

    Those of them that stand still are counted once more, as `queued`. `seen` is the share of a
    lane's reach that lay within sight of a LiDAR whose scan was used, so that 0 is "nobody saw it";
    empty where nobody can know: agents send boxes of their own, or none has a LiDAR.
    """

    kind: ClassVar[int] = 12
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    agents: Ids
    complete: bool
    upstream: Counts
    downstream: Counts
    queued_upstream: Counts = Field({})
    queued_downstream: Counts = Field({})
    seen_upstream: Shares = Field({})
    seen_downstream: Shares = Field({})
    delay_sim_ns: DelayNs | None = None


class Plan(Message):
    """What an agent shall send: its part of the scene from `frame` on, until a newer plan comes.

    The parts are cells of a power diagram: a place x, y belongs to the agent with the least
    |place - site|^2 - weight, ties to the first of the list. `sites` are in m in the map frame, in
    the order of `agents`; `weights_m2` holds for each agent the tight, the plain and the wide
    weight. All agents of a frame get the same arrays; without cells they are empty.

    `mbps` is what the agent's uplink carries as the edge believes, 0 if it does not know. Of
    `enough` and the frames before it no more chunks are needed; where links are virtual,
    `enough_sim_ns` says since when.
    """

    kind: ClassVar[int] = 15
    frame: FrameNumber
    agent: Id
    mbps: float = Field(ge=0, le=1e6)
    enough: int = Field(ge=-1, lt=1 << 40)
    enough_sim_ns: TimeNs | None = None
    agents: Ids
    sites: Sites
    weights_m2: Borders

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "agents", "sites", "weights_m2")
        return self
