"""Messages on the V2X bus: what agents upload, what the edge publishes, the signal's state."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from protocol.limits import (
    MAX_CHUNKS,
    MAX_COUNT,
    MAX_HEIGHT_M,
    MAX_ITEMS,
    MAX_LENGTH_M,
    MAX_MBPS,
    MAX_POSITION_STD_M,
    MAX_SPEED_MPS,
    MAX_WIDTH_M,
)
from protocol.messages.fields import (
    BOUNDED,
    AgentId,
    Ages,
    Boxes,
    BoxRows,
    Bytes,
    Count,
    DelayNs,
    Deviations,
    Equipment,
    Floats32,
    FrameNumber,
    Id,
    Ids,
    Lights,
    Message,
    NetId,
    ObjectClasses,
    Pose,
    Sites,
    Speeds,
    Text,
    Texts,
    TimeNs,
    TrackIds,
    Weights,
    check_lengths,
)


class Roster(Message):
    """The agents that a process hosts in a frame, and which of them send a scan."""

    kind: ClassVar[int] = 8
    frame: FrameNumber
    process: Id
    agents: Ids
    scanning: Ids


class AgentPose(Message):
    """An agent's estimated pose (footprint centre on the ground) and its size."""

    kind: ClassVar[int] = 9
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: AgentId
    equipment: Equipment
    pose: Pose
    length_m: float = Field(ge=0, le=MAX_LENGTH_M)
    width_m: float = Field(ge=0, le=MAX_WIDTH_M)
    height_m: float = Field(ge=0, le=MAX_HEIGHT_M)
    position_std_m: float = Field(ge=0, le=MAX_POSITION_STD_M)
    arrival_sim_ns: TimeNs | None = None


class Scan(Message):
    """One chunk of an encoded scan. `sensor_pose` is `map_SE3_sensor` as the agent estimates it.

    Chunks are numbered from 0 and sent in this order. `plan_frame` is the frame of the plan that
    the chunks were cut by, -1 for none. `ground_free` says that the agent has taken away what
    belongs to the ground and to the static scene.
    """

    kind: ClassVar[int] = 10
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: AgentId
    chunk: int = Field(ge=0)
    chunks: int = Field(ge=1, le=MAX_CHUNKS)
    points: Count
    plan_frame: int = Field(-1, ge=-1, lt=MAX_COUNT)
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
    """Objects that an agent detected on board, sent instead of a scan.

    Boxes are as in `Detections`, in the map frame as the agent estimates it.
    """

    kind: ClassVar[int] = 16
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: AgentId
    boxes: Boxes
    scores: Floats32
    classes: ObjectClasses
    sense_start_ns: TimeNs
    sense_end_ns: TimeNs
    detect_end_ns: TimeNs
    arrival_sim_ns: TimeNs | None = None

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "boxes", "scores", "classes")
        return self


class Detections(Message):
    """Vehicles and people of a frame; `classes` are of `ObjectClass`.

    Boxes are x, y, z of the centre, length, width, height in m and yaw in rad. `distances_m` is the
    distance along the lane to the stop bar, negative behind it. `sources` is "lidar" or the agent
    whose own pose it is. `lanes` holds an empty string where a box is on no lane.

    Each box is that of a track (see docs/tracking.md): `track_ids` are unique in a run's city, 0
    without tracking. `speeds_mps` are along the heading, `ages_s` since the track's first
    detection. A track that was not detected in this frame coasts: `coasted_s` is the time since it
    last was, 0 for all others, and its score is the probability that the vehicle is still there.
    Standard deviations are those of the position along the heading and of the speed.
    """

    kind: ClassVar[int] = 11
    frame: FrameNumber
    sim_time_ns: TimeNs
    agents: Ids
    boxes: BoxRows
    scores: Floats32
    classes: ObjectClasses
    lanes: Texts
    distances_m: Floats32
    sources: Texts
    track_ids: TrackIds
    speeds_mps: Speeds
    coasted_s: Ages
    ages_s: Ages
    position_std_m: Deviations
    speed_std_mps: Deviations

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "boxes", "scores", "classes", "lanes", "distances_m", "sources")
        check_lengths(self, "boxes", "track_ids", "speeds_mps", "coasted_s", "ages_s")
        check_lengths(self, "boxes", "position_std_m", "speed_std_mps")
        return self


Counts = Annotated[dict[NetId, Count], *BOUNDED]
PassengerCarUnits = Annotated[dict[NetId, Annotated[float, Field(ge=0, le=MAX_COUNT)]], *BOUNDED]
CoverageShares = Annotated[dict[NetId, Annotated[float, Field(ge=0, le=1)]], *BOUNDED]


class LaneCounts(Message):
    """Vehicles per lane: within the reach upstream of the stop bar and downstream behind it.

    Stationary ones are counted once more, as `queued`, and all of them in passenger-car units (a
    lorry is worth several cars), as `pcu`. Those that no sensor saw in this frame, whose tracks
    coast, are counted once more, as `coasted`. `coverage` is the share of a lane's reach
    within the range of a LiDAR whose scan was used, and within the part of the scene that it is of
    where an agent sends its own part, so that 0 is "not observed"; empty where it is
    unknown: agents send boxes of their own, or none has a LiDAR. `coverage_from_bar` is the part of
    the upstream one from the stop bar on to its first gap: who sees a lane's far end alone says
    nothing of its queue.
    """

    kind: ClassVar[int] = 12
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    agents: Ids
    complete: bool
    upstream: Counts
    downstream: Counts
    stationary_upstream: Counts = Field({})
    stationary_downstream: Counts = Field({})
    pcu_upstream: PassengerCarUnits = Field({})
    pcu_downstream: PassengerCarUnits = Field({})
    coasted_upstream: Counts = Field({})
    coasted_downstream: Counts = Field({})
    coverage_upstream: CoverageShares = Field({})
    coverage_downstream: CoverageShares = Field({})
    coverage_from_bar: CoverageShares = Field({})
    delay_sim_ns: DelayNs | None = None


class BorderObjects(Message):
    """Objects in the border strips that a region's edge shares with its neighbours.

    Boxes are as in `Detections`, before the owners of the lanes are known; `position_std_m` is as
    in `AgentPose`, 0 for boxes of LiDARs. `sensors` are the places of the sensors whose data were
    used, in m in the map frame: what is near none of them is unknown, not empty. Those whose data
    are of their own part of the scene alone are not among them.

    `tracks` are those in the strips after the edge's last frame, `track_sim_time_ns`, so that a
    vehicle keeps its track's id from region to region.
    """

    kind: ClassVar[int] = 20
    frame: FrameNumber
    sim_time_ns: TimeNs
    boxes: Boxes
    scores: Floats32
    classes: ObjectClasses
    sources: Texts
    position_std_m: Floats32
    sensors: Sites
    track_sim_time_ns: TimeNs = 0
    track_ids: TrackIds
    track_boxes: Boxes
    track_classes: ObjectClasses
    track_speeds_mps: Speeds
    track_coasted_s: Ages
    track_ages_s: Ages

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "boxes", "scores", "classes", "sources", "position_std_m")
        check_lengths(self, "track_ids", "track_boxes", "track_classes", "track_speeds_mps")
        check_lengths(self, "track_ids", "track_coasted_s", "track_ages_s")
        if len(self.sensors) > MAX_ITEMS:
            raise ValueError(f"{len(self.sensors)} sensors, limit {MAX_ITEMS}")
        if not ((self.position_std_m >= 0) & (self.position_std_m <= MAX_POSITION_STD_M)).all():
            raise ValueError(f"a position_std_m is not within 0 to {MAX_POSITION_STD_M:g} m")
        return self


class Plan(Message):
    """Upload plan of an agent: its part of the scene from `frame` on, until a newer plan comes.

    The parts are cells of a power diagram: a place x, y belongs to the agent with the least
    |place - site|^2 - weight, ties to the first of the list. `sites` are in m in the map frame, in
    the order of `agents`; `weights_m2` holds for each agent the tight, the plain and the wide
    weight. All agents of a frame get the same arrays; without cells they are empty.

    `mbps` is what the agent's uplink carries by the edge's estimate, 0 if it has none. Of
    `enough` and the frames before it no more chunks are needed; where links are virtual,
    `enough_sim_ns` says since when.
    """

    kind: ClassVar[int] = 15
    frame: FrameNumber
    agent: Id
    mbps: float = Field(ge=0, le=MAX_MBPS)
    enough: int = Field(ge=-1, lt=MAX_COUNT)
    enough_sim_ns: TimeNs | None = None
    agents: Ids
    sites: Sites
    weights_m2: Weights

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "agents", "sites", "weights_m2")
        return self


class SignalState(Message):
    """Signal phase and timing (SPaT). `stage` is green, yellow or all_red; `source` who asked."""

    kind: ClassVar[int] = 6
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    state: Lights
    stage: Text
    green: Text
    source: Text
    earliest_change_ns: TimeNs


class SignalRequest(Message):
    """A policy's wish: the green state to show, one character per link.

    `policy` is what decided, "plan" where the policy knew too little and fell back on the fixed
    plan. Until `not_before_ns`, in simulated time, what was requested before holds; a time that has
    passed means at once. `unknown` are the lanes without sensor coverage, whose vehicles were
    estimated. `advised` is how many vehicles get a `SpeedAdvice` in this frame, which may arrive
    before it or after it.
    """

    kind: ClassVar[int] = 7
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    state: Text
    policy: Text
    pressures: Annotated[list[float], *BOUNDED] = Field([])
    unknown: Annotated[list[NetId], *BOUNDED] = Field([])
    advised: int = Field(0, ge=0, le=MAX_ITEMS)
    not_before_ns: TimeNs = 0
    delay_sim_ns: DelayNs | None = None


class SpeedAdvice(Message):
    """Speed advice (GLOSA): the speed at which a vehicle reaches the stop bar at green.

    None ends an earlier advice of the same signal: the vehicle drives freely.
    """

    kind: ClassVar[int] = 23
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    agent: AgentId
    speed_mps: Annotated[float, Field(gt=0, le=MAX_SPEED_MPS)] | None
    delay_sim_ns: DelayNs | None = None
