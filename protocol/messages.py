"""Every message, as a frozen record: scalars go into the header, arrays into the body.

Times ending in `_ns` without `sim_` come from `time.monotonic_ns` of the process that wrote them.
Poses are x, y, z in m and roll, pitch, yaw in rad, in the map frame.

Every number, text and list has a bound, so that one absurd message cannot spoil what is kept.
Where links are virtual, `arrival_sim_ns` says when, in simulated time, the edge has a message, and
`delay_sim_ns` how long after the frame's time a result is there; else they are None. What arrives
at `NEVER_NS` was taken off the link before it left.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, model_validator

from protocol import arrays
from protocol.arrays import Boxes, Bytes, Floats32, Indices, Triangles, Vertices
from protocol.roadmap import RoadMap

MAX_ITEMS = 4096  # of a list or map
_REACH = np.array([1e7, 1e7, 1e7, 1e3, 1e3, 1e3])  # m, rad: farther than any map


def _within_reach(poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(poses) <= _REACH).all():
        raise ValueError("a pose lies beyond 1e7 m or 1e3 rad")
    return poses


def _on_the_map(sites: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(sites) <= _REACH[0]).all():
        raise ValueError("a site lies beyond 1e7 m")
    return sites


def _moderate(weights_m2: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if not (np.abs(weights_m2) <= _REACH[0] ** 2).all():
        raise ValueError("a weight lies beyond 1e14 m^2")
    return weights_m2


Id = Annotated[str, Field(min_length=1, max_length=128)]
Text = Annotated[str, Field(max_length=512)]
NetId = Annotated[str, Field(min_length=1, max_length=512)]  # joined junctions have long ones
FrameNumber = Annotated[int, Field(ge=0, lt=1 << 40)]
Count = Annotated[int, Field(ge=0, lt=1 << 40)]
Total = Annotated[int, Field(ge=0, lt=1 << 53)]
TimeNs = Annotated[int, Field(gt=-(1 << 62), lt=1 << 62)]  # so that differences fit into 64 bit
Sites = Annotated[arrays.Sites, AfterValidator(_on_the_map)]
Borders = Annotated[arrays.Borders, AfterValidator(_moderate)]
Pose = Annotated[arrays.Pose6, AfterValidator(_within_reach)]
Poses = Annotated[arrays.Poses, AfterValidator(_within_reach)]
_Bounded = (FailFast(), Field(max_length=MAX_ITEMS))  # one error will do, a million cost memory
Ids = Annotated[list[Id], *_Bounded]
Texts = Annotated[list[Text], *_Bounded]
MAX_DELAY_NS = 60_000_000_000
NEVER_NS = (1 << 62) - 1  # the arrival of what a virtual link was not given any more
DelayNs = Annotated[int, Field(ge=0, le=MAX_DELAY_NS)]


class Equipment(IntEnum):
    """What a vehicle carries: nothing, a LiDAR and a radio, or a radio alone."""

    NONE = 0
    CAV = 1
    CV = 2


class Message(BaseModel):
    """Base of all messages. Unknown header fields are tolerated, so that a minor side may add."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", arbitrary_types_allowed=True, allow_inf_nan=False
    )
    kind: ClassVar[int]
    max_header_bytes: ClassVar[int] = 256 << 10


class Part(BaseModel):
    """Base of what messages hold lists of."""

    model_config = ConfigDict(allow_inf_nan=False)


class VehicleType(Part):
    """A SUMO vType as sensors see it: a mesh of the setup, scaled to these sizes."""

    name: Text
    mesh: Text
    length_m: float
    width_m: float
    height_m: float


class MeshPart(Part):
    """Where one mesh lies in the setup's vertex and triangle arrays."""

    name: Text
    vertices: int
    triangles: int


class Setup(Message):
    """What every process is given before the first frame.

    Meshes are unit sized: the footprint's centre at the origin on the ground, x forward, extent 1
    along each axis. Triangles index into their own mesh.
    """

    kind: ClassVar[int] = 1
    max_header_bytes: ClassVar[int] = 16 << 20  # two recorded links take 9 MiB at most
    scenario: dict[str, Any]
    road_map: RoadMap
    vehicle_types: list[VehicleType]
    meshes: list[MeshPart]
    mesh_vertices: Vertices
    mesh_triangles: Triangles
    polygons: list[list[tuple[float, float]]] = []
    polygon_heights_m: list[float] = []


class Tick(Message):
    """Where every body is at the start of a frame.

    A pose is that of the footprint's centre on the ground. `hosts` is an index into `processes`:
    the vehicle process that plays this vehicle, or -1.
    """

    kind: ClassVar[int] = 2
    frame: FrameNumber
    sim_time_ns: TimeNs
    processes: Ids
    ids: Ids
    types: Texts
    poses: Poses
    speeds_mps: Floats32
    equipment: Bytes
    hosts: Indices

    @model_validator(mode="after")
    def _agree(self) -> Self:
        _check_bodies(self, "ids", "types", "poses", "speeds_mps", "equipment", "hosts")
        if not ((self.hosts >= -1) & (self.hosts < len(self.processes))).all():
            raise ValueError(f"a host is none of the {len(self.processes)} processes")
        return self


class Truth(Message):
    """What perception ought to have seen; for the recorder alone."""

    kind: ClassVar[int] = 3
    frame: FrameNumber
    sim_time_ns: TimeNs
    ids: Ids
    types: Texts
    lanes: Texts
    poses: Poses
    speeds_mps: Floats32
    lane_positions_m: Floats32
    equipment: Bytes

    @model_validator(mode="after")
    def _agree(self) -> Self:
        _check_bodies(
            self, "ids", "types", "lanes", "poses", "speeds_mps", "lane_positions_m", "equipment"
        )
        return self

    @property
    def cavs(self) -> list[str]:
        """Ids of the vehicles with a LiDAR."""
        kinds = zip(self.ids, self.equipment.tolist(), strict=True)
        return [vehicle for vehicle, kind in kinds if kind == Equipment.CAV]


class Trip(Part):
    """One vehicle's journey over the signal.

    `time_loss_s` is what it lost within reach of the signal, since frame 0 or since it came there.
    `arrive_s` is None while it is still under way at the end.
    """

    vehicle: Id
    equipment: Equipment
    depart_s: float
    arrive_s: float | None
    time_loss_s: float
    teleported: bool = False


class Trips(Message):
    """Journeys that ended in this frame, or that the end of the run cut off."""

    kind: ClassVar[int] = 4
    frame: FrameNumber
    trips: Annotated[list[Trip], *_Bounded]


class End(Message):
    """The world has stopped; `frames` ticks were published.

    `waiting` vehicles had found no room to enter the net.
    """

    kind: ClassVar[int] = 5
    frames: FrameNumber
    reason: Text
    waiting: Count = 0


class SignalState(Message):
    """Signal phase and timing (SPaT). `stage` is green, yellow or all_red; `source` who asked."""

    kind: ClassVar[int] = 6
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    state: Text
    stage: Text
    green: Text
    source: Text
    earliest_change_ns: TimeNs


class SignalRequest(Message):
    """A policy's wish: the green state to be shown, one character per link."""

    kind: ClassVar[int] = 7
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    state: Text
    policy: Text
    pressures: Annotated[list[float], *_Bounded] = []
    delay_sim_ns: DelayNs | None = None


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
    agent: Id
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
    agent: Id
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
    boxes: Boxes
    scores: Floats32
    lanes: Texts
    distances_m: Floats32
    sources: Texts

    @model_validator(mode="after")
    def _agree(self) -> Self:
        _check_lengths(self, "boxes", "scores", "lanes", "distances_m", "sources")
        return self


class LaneCounts(Message):
    """Vehicles per lane: within the reach upstream of the stop bar and downstream behind it."""

    kind: ClassVar[int] = 12
    frame: FrameNumber
    sim_time_ns: TimeNs
    tls: NetId
    agents: Ids
    complete: bool
    upstream: dict[NetId, Count] = Field(max_length=MAX_ITEMS)
    downstream: dict[NetId, Count] = Field(max_length=MAX_ITEMS)
    delay_sim_ns: DelayNs | None = None


class Span(Part):
    """One stage of one frame; `agent` is empty for stages that serve all."""

    stage: Text
    agent: Text = ""
    start_ns: TimeNs
    end_ns: TimeNs


class Upload(Part):
    """One chunk as its sender saw it.

    `link_sim_ns` is its time on a virtual link, the queue before it included.
    """

    agent: Id
    chunk: Count
    points: Count
    payload_bytes: Count
    sense_start_ns: TimeNs
    sense_end_ns: TimeNs
    encode_end_ns: TimeNs
    sent_ns: TimeNs
    link_sim_ns: DelayNs | None = None


class WireCount(Part):
    """What TCP sent for an agent from one frame's upload until the next one's began.

    Over a virtual link: what the link took of the frame, with the headers of TCP and IP.
    """

    agent: Id
    frame: FrameNumber
    sent_bytes: Count


class Arrival(Part):
    """The same chunk as the edge saw it."""

    agent: Id
    chunk: Count
    received_ns: TimeNs
    decoded_ns: TimeNs


class Metrics(Message):
    """What one process did in one frame. `drops` counts since its start, by reason.

    `wire` settles earlier frames: only when the next upload begins has TCP sent all of the last.
    """

    kind: ClassVar[int] = 13
    process: Id
    frame: FrameNumber
    sim_time_ns: TimeNs
    spans: Annotated[list[Span], *_Bounded] = []
    uploads: Annotated[list[Upload], *_Bounded] = []
    wire: Annotated[list[WireCount], *_Bounded] = []
    arrivals: Annotated[list[Arrival], *_Bounded] = []
    points: Count = 0
    drops: dict[Id, Total] = Field({}, max_length=MAX_ITEMS)


class Progress(Message):
    """The run at a glance, about once a second, for whoever watches."""

    kind: ClassVar[int] = 14
    frame: FrameNumber
    sim_time_ns: TimeNs
    real_time_factor: float
    vehicles: Count
    cavs: Count
    cvs: Count
    detections: Count
    mbps: dict[Id, float] = Field(max_length=MAX_ITEMS)
    end_to_end_ms: float
    state: Text
    drops: Total


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
        _check_lengths(self, "agents", "sites", "weights_m2")
        return self


class Objects(Message):
    """What an agent that detects for itself found, in the place of a scan.

    Boxes are as in `Detections`, in the map frame as the agent believes it.
    """

    kind: ClassVar[int] = 16
    frame: FrameNumber
    sim_time_ns: TimeNs
    agent: Id
    boxes: Boxes
    scores: Floats32
    sense_start_ns: TimeNs
    sense_end_ns: TimeNs
    detect_end_ns: TimeNs
    arrival_sim_ns: TimeNs | None = None

    @model_validator(mode="after")
    def _agree(self) -> Self:
        _check_lengths(self, "boxes", "scores")
        return self


def _check_bodies(message: Tick | Truth, *columns: str) -> None:
    _check_lengths(message, *columns)
    if len(set(message.ids)) < len(message.ids):
        raise ValueError("an id stands there twice")
    if (message.equipment > max(Equipment)).any():
        raise ValueError(f"equipment {message.equipment.max()} is none of {[*map(int, Equipment)]}")


def _check_lengths(message: Message, *columns: str) -> None:
    lengths = {name: len(getattr(message, name)) for name in columns}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"lists have lengths {lengths}, need one")


class TimeReply(Message):
    """What the host of the world bus answers to who asks for its clock."""

    kind: ClassVar[int] = 17
    machine: Text
    heard_ns: TimeNs
    told_ns: TimeNs


class ClockReading(Message):
    """What to add to a process's clock to have that of the world bus's host.

    It is wrong by `error_ns` at most; both are 0 on the same machine.
    """

    kind: ClassVar[int] = 18
    process: Id
    offset_ns: TimeNs
    error_ns: TimeNs = Field(ge=0)


MESSAGES: dict[int, type[Message]] = {m.kind: m for m in Message.__subclasses__()}
