"""Metrics of processes per frame, and the progress of a run, for the recorder and observers."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from protocol.limits import MAX_ITEMS
from protocol.messages.fields import (
    BOUNDED,
    AgentId,
    Count,
    DelayNs,
    FrameNumber,
    Id,
    Lights,
    Message,
    NetId,
    Part,
    Text,
    TimeNs,
    Total,
)


class Span(Part):
    """One stage of one frame; `agent` is empty for stages that serve all.

    Those that serve all follow one another; others may overlap, for several agents are served at
    once.
    """

    stage: Text
    agent: Text = ""
    start_ns: TimeNs
    end_ns: TimeNs


class Upload(Part):
    """One chunk as its sender saw it.

    It was sent to the edge of `region`. `link_sim_ns` is its time on a virtual link, the queue
    before it included.
    """

    agent: AgentId
    region: Id
    chunk: Count
    points: Count
    payload_bytes: Count
    sense_start_ns: TimeNs
    sense_end_ns: TimeNs
    encode_end_ns: TimeNs
    sent_ns: TimeNs
    link_sim_ns: DelayNs | None = None


class WireCount(Part):
    """Bytes that an agent sent and received between two frame starts, as IP packets.

    Everything is in it: scans and poses, its share of its process's rosters, plans,
    acknowledgements, headers of Zenoh, TLS, TCP and IP, and repetitions.
    """

    agent: AgentId
    frame: FrameNumber
    sent_bytes: Count
    received_bytes: Count = 0


class Arrival(Part):
    """The same chunk as the edge saw it."""

    agent: AgentId
    chunk: Count
    received_ns: TimeNs
    decoded_ns: TimeNs


Score = Annotated[float, Field(ge=0, le=1)]


class AgentScore(Part):
    """Misbehaviour score of an agent, 0 (excluded from the frame) to 1 (trusted).

    Of this frame alone: its motion, its position on the road, the ground in its cloud; None where
    there was nothing to check.
    """

    agent: Id
    score: Score
    trusted: bool
    motion: Score | None = None
    place: Score | None = None
    ground: Score | None = None


class AgentAlignment(Part):
    """Pose error of an agent, as the edge estimates it: claimed minus found, map frame.

    `std_m` is the standard deviation of x and of y, the larger. Of the scan's `points` where the
    edge's static map has data, the share `inliers` fits it.
    """

    agent: Id
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    std_m: float = Field(ge=0)
    points: Count
    inliers: Score
    excluded: bool


class Metrics(Message):
    """Metrics of one process in one frame.

    `drops` counts since its start, by reason.

    `scores` are of agents that are excluded, and of those whose score has changed; `alignments` are
    of those whose scan of this frame was registered.

    `wire` settles earlier frames: only when the next upload begins has TCP sent all of the last.
    `border_bytes` are those that an edge sent to its neighbours, once for each.
    """

    kind: ClassVar[int] = 13
    process: Id
    frame: FrameNumber
    sim_time_ns: TimeNs
    spans: Annotated[list[Span], *BOUNDED] = Field([])
    uploads: Annotated[list[Upload], *BOUNDED] = Field([])
    wire: Annotated[list[WireCount], *BOUNDED] = Field([])
    arrivals: Annotated[list[Arrival], *BOUNDED] = Field([])
    scores: Annotated[list[AgentScore], *BOUNDED] = Field([])
    alignments: Annotated[list[AgentAlignment], *BOUNDED] = Field([])
    points: Count = 0
    border_bytes: Count = 0
    drops: Annotated[dict[Id, Total], *BOUNDED] = Field({})


class RegionProgress(Part):
    """A region: agents and detections of its newest frame, frames since the recorder began."""

    agents: Count
    detections: Count
    frames: Count
    incomplete: Count
    mbps: float
    end_to_end_ms: float


class JunctionProgress(Part):
    """A junction in the newest frame; `vehicles` and `queued` are before its stop bars.

    `phase` is the number of the green, in the order of `Signal.greens`, that is shown or was shown
    last, -1 if there is none such. `coverage` is the share of the lanes before the stop bars
    that sensors cover, None if it is unknown.
    """

    region: Id
    phase: int = Field(ge=-1, lt=MAX_ITEMS)
    unchanged_s: float = Field(ge=0)
    vehicles: Count
    queued: Count
    coverage: Score | None = None


class Progress(Message):
    """The progress of the run, about once a second, for observers.

    `junctions` are by the id of their signal; `state` is that of the first.
    """

    kind: ClassVar[int] = 14
    frame: FrameNumber
    sim_time_ns: TimeNs
    real_time_factor: float
    vehicles: Count
    cavs: Count
    cvs: Count
    detections: Count
    mbps: Annotated[dict[Id, float], *BOUNDED]
    end_to_end_ms: float
    state: Lights
    drops: Total
    regions: Annotated[dict[Id, RegionProgress], *BOUNDED] = Field({})
    junctions: Annotated[dict[NetId, JunctionProgress], *BOUNDED] = Field({})
