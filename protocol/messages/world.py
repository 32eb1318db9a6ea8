"""Messages on the world bus: setup, ticks, ground truth, trips, the end, and the host's clock."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import FailFast, Field, model_validator

from protocol.limits import MAX_ITEMS, MAX_SETUP_HEADER_BYTES, MAX_WORLD_HEADER_BYTES
from protocol.messages.fields import (
    BOUNDED,
    BodyIds,
    BodyTexts,
    Bytes,
    Cells,
    Count,
    Equipment,
    Floats32,
    FrameNumber,
    Frames,
    Id,
    Ids,
    Indices,
    Message,
    ObjectClass,
    Part,
    Poses,
    Sites,
    Text,
    TileNumber,
    TimeNs,
    Triangles,
    Vertices,
    check_lengths,
)
from protocol.roadmap import RoadMap

PARKED, PEDESTRIAN = "parked~", "pedestrian~"
"""Id prefixes of bodies that are not vehicles in traffic; no vehicle's id begins so."""


def is_bystander(body: str) -> bool:
    """Whether a body is a parked car or a pedestrian, by its id: it is never counted in lanes."""
    return body.startswith((PARKED, PEDESTRIAN))


Ring = Annotated[list[tuple[float, float]], FailFast()]


class VehicleType(Part):
    """A SUMO vType as sensors see it: a mesh of the setup, scaled to these sizes."""

    name: Text
    mesh: Text
    length_m: float
    width_m: float
    height_m: float
    object_class: ObjectClass = ObjectClass.CAR


class MeshPart(Part):
    """Where one mesh lies in the setup's vertex and triangle arrays."""

    name: Text
    vertices: int
    triangles: int


class Setup(Message):
    """Setup of a run, which every process receives before the first frame.

    Meshes are unit sized: the footprint's centre at the origin on the ground, x forward, extent 1
    along each axis. Triangles index into their own mesh; each has its `Material` in
    `mesh_materials` (T,), which is empty if all are paint. Parked cars, of these types and with
    these poses (P, 6) of their footprints' centres, are bodies of all ticks, but not in the truth:
    it holds traffic. `version` is that of the cpnet that made
    the setup, empty if it did not say.
    """

    kind: ClassVar[int] = 1
    max_header_bytes: ClassVar[int] = MAX_SETUP_HEADER_BYTES
    scenario: Annotated[dict[str, Any], FailFast()]
    road_map: RoadMap
    vehicle_types: Annotated[list[VehicleType], FailFast()]
    meshes: Annotated[list[MeshPart], FailFast()]
    mesh_vertices: Vertices
    mesh_triangles: Triangles
    mesh_materials: Bytes = Field(default_factory=lambda: np.zeros(0, np.uint8))
    polygons: Annotated[list[Ring], FailFast()] = Field([])
    polygon_heights_m: Annotated[list[float], FailFast()] = Field([])
    parked_types: BodyTexts = Field([])
    parked_poses: Poses = Field(default_factory=lambda: np.zeros((0, 6)))
    version: Text = ""

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "parked_types", "parked_poses")
        return self

    @property
    def parked_ids(self) -> list[str]:
        """Ids of the parked cars in ticks and sightings (P,)."""
        return [f"{PARKED}{n}" for n in range(len(self.parked_types))]


class Tick(Message):
    """Start of a frame: which process plays which agents, and which map tiles hold bodies.

    `hosts` is an index into `processes`: the vehicle process that plays this agent, or -1. Where
    the bodies of a tile are now is in its `TileBodies` of the frame `since`: they are not
    sent again while nothing in the tile moves.

    Attributes:
        bodies: how many vehicles there are in all tiles; not those parked, and no pedestrians.
        agents: ids of the CAVs and CVs (N,), with `equipment` (N,) and `hosts` (N,).
        places: (N, 2) x, y of their footprints' centres, map frame, m.
        tiles: (T, 2) column and row, see `protocol.tiles`.
        since: (T,) frames.
    """

    kind: ClassVar[int] = 2
    max_header_bytes: ClassVar[int] = MAX_WORLD_HEADER_BYTES
    frame: FrameNumber
    sim_time_ns: TimeNs
    processes: Ids
    bodies: Count
    agents: BodyIds
    equipment: Bytes
    hosts: Indices
    places: Sites
    tiles: Cells
    since: Frames

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "agents", "equipment", "hosts", "places")
        check_lengths(self, "tiles", "since")
        _check_ids(self.agents)
        _check_equipment(self.equipment)
        if not ((self.hosts >= -1) & (self.hosts < len(self.processes))).all():
            raise ValueError(f"a host is none of the {len(self.processes)} processes")
        return self


class TileBodies(Message):
    """Where every body in a tile of the map is from a frame on, until the next such message.

    A pose is that of the footprint's centre on the ground, map frame.
    """

    kind: ClassVar[int] = 21
    max_header_bytes: ClassVar[int] = MAX_WORLD_HEADER_BYTES
    frame: FrameNumber
    column: TileNumber
    row: TileNumber
    ids: BodyIds
    types: BodyTexts
    poses: Poses
    speeds_mps: Floats32

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "ids", "types", "poses", "speeds_mps")
        _check_ids(self.ids)
        return self


class TileRequest(Message):
    """Request to publish bodies again: of tiles (T, 2), column and row, that a process lacks."""

    kind: ClassVar[int] = 22
    tiles: Cells

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if len(self.tiles) > MAX_ITEMS:
            raise ValueError(f"{len(self.tiles)} tiles, limit {MAX_ITEMS}")
        return self


class Truth(Message):
    """Ground truth of a frame; for the recorder alone."""

    kind: ClassVar[int] = 3
    max_header_bytes: ClassVar[int] = MAX_WORLD_HEADER_BYTES
    frame: FrameNumber
    sim_time_ns: TimeNs
    ids: BodyIds
    types: BodyTexts
    lanes: BodyTexts
    poses: Poses
    speeds_mps: Floats32
    lane_positions_m: Floats32
    equipment: Bytes

    @model_validator(mode="after")
    def _agree(self) -> Self:
        columns = ("types", "lanes", "poses", "speeds_mps", "lane_positions_m", "equipment")
        check_lengths(self, "ids", *columns)
        _check_ids(self.ids)
        _check_equipment(self.equipment)
        return self

    @property
    def cavs(self) -> list[str]:
        """Ids of the vehicles with a LiDAR."""
        kinds = zip(self.ids, self.equipment.tolist(), strict=True)
        return [vehicle for vehicle, kind in kinds if kind == Equipment.CAV]


class Sighting(Message):
    """Number of points of an agent's scan on each vehicle; for the recorder alone.

    Vehicles without a point are left out.
    """

    kind: ClassVar[int] = 19
    frame: FrameNumber
    agent: Id
    vehicles: Ids
    points: Indices

    @model_validator(mode="after")
    def _agree(self) -> Self:
        check_lengths(self, "vehicles", "points")
        if (self.points < 1).any():
            raise ValueError(f"{self.points.min()} points on a vehicle, allowed: 1 and more")
        return self


class Trip(Part):
    """One vehicle's journey over the signal.

    `time_loss_s` is what it lost within reach of the signal, since frame 0 or since it came there;
    so often it came to a halt there (slower than 0.1 m/s), so much CO2 it emitted, by SUMO's model.
    `arrive_s` is None while it is still under way at the end.
    """

    vehicle: Id
    equipment: Equipment
    depart_s: float
    arrive_s: float | None
    time_loss_s: float
    teleported: bool = False
    stops: Count = 0
    co2_g: float = 0.0


class Trips(Message):
    """Journeys that ended in this frame, or that the end of the run cut off."""

    kind: ClassVar[int] = 4
    frame: FrameNumber
    trips: Annotated[list[Trip], *BOUNDED]


class End(Message):
    """The world has stopped; `frames` ticks were published.

    `waiting` vehicles had found no room to enter the net.
    """

    kind: ClassVar[int] = 5
    frames: FrameNumber
    reason: Text
    waiting: Count = 0


def _check_ids(ids: list[str]) -> None:
    if len(set(ids)) < len(ids):
        raise ValueError("an id stands there twice")


def _check_equipment(equipment: npt.NDArray[np.uint8]) -> None:
    if (equipment > max(Equipment)).any():
        raise ValueError(f"equipment {equipment.max()} is none of {[*map(int, Equipment)]}")


class TimeReply(Message):
    """Reply of the world bus's host to a query for its clock."""

    kind: ClassVar[int] = 17
    machine: Text
    received_ns: TimeNs
    replied_ns: TimeNs


class ClockReading(Message):
    """Offset from a process's clock to that of the world bus's host.

    It is wrong by `error_ns` at most; both are 0 on the same machine.
    """

    kind: ClassVar[int] = 18
    process: Id
    offset_ns: TimeNs
    error_ns: TimeNs = Field(ge=0)
