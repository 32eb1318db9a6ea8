"""Every message, as a frozen record: scalars go into the header, arrays into the body.

Times ending in `_ns` without `sim_` come from `time.monotonic_ns` of the process that wrote them.
Poses are x, y, z in m and roll, pitch, yaw in rad, in the map frame.
Where links are virtual, `arrival_sim_ns` says when, in simulated time, the edge has a message, and
`delay_sim_ns` how long after the frame's time a result is there; else they are None.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from protocol.arrays import Boxes, Bytes, Floats32, Indices, Pose6, Poses, Triangles, Vertices
from protocol.roadmap import RoadMap

Id = str
MAX_DELAY_NS = 60_000_000_000


class Equipment(IntEnum):
    """What a vehicle carries: nothing, a LiDAR and a radio, or a radio alone."""

    NONE = 0
    CAV = 1
    CV = 2


class Message(BaseModel):
    """Base of all messages. Unknown header fields are tolerated, so that a minor side may add."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)
    kind: ClassVar[int]


class VehicleType(BaseModel):
    """A SUMO vType as sensors see it: a mesh of the setup, scaled to these sizes."""

    name: str
    mesh: str
    length_m: float
    width_m: float
    height_m: float


class MeshPart(BaseModel):
    """Where one mesh lies in the setup's vertex and triangle arrays."""

    name: str
    vertices: int
    triangles: int


class Setup(Message):
    """What every process is given before the first frame.

    Meshes are unit sized: the footprint's centre at the origin on the ground, x forward, extent 1
    along each axis. Triangles index into their own mesh.
    """

    kind: ClassVar[int] = 1
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
    frame: int = Field(ge=0)
    sim_time_ns: int
    processes: list[Id]
    ids: list[Id]
    types: list[str]
    poses: Poses
    speeds_mps: Floats32
    equipment: Bytes
    hosts: Indices


class Truth(Message):
    """What perception ought to have seen; for the recorder alone."""

    kind: ClassVar[int] = 3
    frame: int
    sim_time_ns: int
    ids: list[Id]
    types: list[str]
    lanes: list[str]
    poses: Poses
    speeds_mps: Floats32
    lane_positions_m: Floats32
    equipment: Bytes


class Trip(BaseModel):
    """One vehicle's journey; `arrive_s` is None while it is still under way at the end."""

    vehicle: Id
    equipment: Equipment
    depart_s: float
    arrive_s: float | None
    time_loss_s: float
    teleported: bool = False


class Trips(Message):
    """Journeys that ended in this frame, or that the end of the run cut off."""

    kind: ClassVar[int] = 4
    frame: int
    trips: list[Trip]


class End(Message):
    """The world has stopped; `frames` ticks were published."""

    kind: ClassVar[int] = 5
    frames: int
    reason: str


class SignalState(Message):
    """Signal phase and timing (SPaT). `stage` is green, yellow or all_red; `source` who asked."""

    kind: ClassVar[int] = 6
    frame: int
    sim_time_ns: int
    tls: str
    state: str
    stage: str
    green: str
    source: str
    earliest_change_ns: int


class SignalRequest(Message):
    """A policy's wish: the green state to be shown, one character per link."""

    kind: ClassVar[int] = 7
    frame: int
    sim_time_ns: int
    tls: str
    state: str
    policy: str
    pressures: list[float] = []
    delay_sim_ns: int | None = Field(None, ge=0, le=MAX_DELAY_NS)


class Roster(Message):
    """Which agents a process speaks for in a frame, and which of them send a scan."""

    kind: ClassVar[int] = 8
    frame: int
    process: Id
    agents: list[Id]
    scanning: list[Id]


class AgentPose(Message):
    """Where an agent believes it is (footprint centre on the ground), and how large it is."""

    kind: ClassVar[int] = 9
    frame: int
    sim_time_ns: int
    agent: Id
    equipment: Equipment
    pose: Pose6
    length_m: float = Field(ge=0, le=60)
    width_m: float = Field(ge=0, le=10)
    height_m: float = Field(ge=0, le=10)
    position_std_m: float = Field(ge=0)
    arrival_sim_ns: int | None = None


class Scan(Message):
    """One chunk of an encoded scan. `sensor_pose` is `map_SE3_sensor` as the agent believes it."""

    kind: ClassVar[int] = 10
    frame: int
    sim_time_ns: int
    agent: Id
    chunk: int = Field(ge=0)
    chunks: int = Field(ge=1, le=64)
    points: int = Field(ge=0)
    sensor_pose: Pose6
    sense_start_ns: int
    sense_end_ns: int
    encode_end_ns: int
    arrival_sim_ns: int | None = None
    payload: Bytes


class Detections(Message):
    """Vehicles of a frame.

    Boxes are x, y, z of the centre, length, width, height in m and yaw in rad. `distances_m` is
    the way to the stop bar, negative behind it. `sources` is "lidar" or the agent whose own pose
    it is. `lanes` holds an empty string where a box is on no lane.
    """

    kind: ClassVar[int] = 11
    frame: int
    sim_time_ns: int
    agents: list[Id]
    boxes: Boxes
    scores: Floats32
    lanes: list[str]
    distances_m: Floats32
    sources: list[str]


class LaneCounts(Message):
    """Vehicles per lane: within the reach upstream of the stop bar and downstream behind it."""

    kind: ClassVar[int] = 12
    frame: int
    sim_time_ns: int
    tls: str
    agents: list[Id]
    complete: bool
    upstream: dict[str, int]
    downstream: dict[str, int]
    delay_sim_ns: int | None = Field(None, ge=0, le=MAX_DELAY_NS)


class Span(BaseModel):
    """One stage of one frame; `agent` is empty for stages that serve all."""

    stage: str
    agent: str = ""
    start_ns: int
    end_ns: int


class Upload(BaseModel):
    """One chunk as its sender saw it. Wire bytes are what TCP sent since the upload before.

    `link_sim_ns` is its time on a virtual link, the queue before it included.
    """

    agent: Id
    chunk: int
    points: int
    payload_bytes: int
    wire_bytes: int
    sense_start_ns: int
    sense_end_ns: int
    encode_end_ns: int
    sent_ns: int
    link_sim_ns: int | None = None


class Arrival(BaseModel):
    """The same chunk as the edge saw it."""

    agent: Id
    chunk: int
    received_ns: int
    decoded_ns: int


class Metrics(Message):
    """What one process did in one frame. `drops` counts since its start, by reason."""

    kind: ClassVar[int] = 13
    process: Id
    frame: int
    sim_time_ns: int
    spans: list[Span] = []
    uploads: list[Upload] = []
    arrivals: list[Arrival] = []
    points: int = 0
    drops: dict[str, int] = {}


class Progress(Message):
    """The run at a glance, about once a second, for whoever watches."""

    kind: ClassVar[int] = 14
    frame: int
    sim_time_ns: int
    real_time_factor: float
    vehicles: int
    cavs: int
    cvs: int
    detections: int
    mbps: dict[str, float]
    end_to_end_ms: float
    state: str
    drops: int


class TimeReply(Message):
    """What the host of the world bus answers to who asks for its clock."""

    kind: ClassVar[int] = 15
    machine: str
    heard_ns: int
    told_ns: int


class ClockReading(Message):
    """What to add to a process's clock to have that of the world bus's host.

    It is wrong by `error_ns` at most; both are 0 on the same machine.
    """

    kind: ClassVar[int] = 16
    process: Id
    offset_ns: int
    error_ns: int = Field(ge=0)


MESSAGES: dict[int, type[Message]] = {m.kind: m for m in Message.__subclasses__()}
