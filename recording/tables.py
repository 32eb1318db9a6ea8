"""The tables of a run: one row type each, the only place where their columns are named.

The SQL statements, the types and the reading side follow from the row types; `recording.rows`
fills them by column name. A change of columns needs a new entry in `SCHEMA_DIGESTS`.

A column's unit is the end of its name. `_ns` without `sim_time` is a process's monotonic clock.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, get_args, get_type_hints

SCHEMA_DIGESTS = {
    8: "9d40949d070f5328",
    9: "242bbfd6b8778425",
    10: "9578cb7e82fa5f20",
    11: "20b6e0ea3ab58717",
    12: "754ca4c0ef3d0560",
    13: "485343937043f86c",
    14: "204697a34aa7044b",
    15: "ddca9e6a84b5fb82",
    16: "3204b3eff040081d",
    17: "4f9c9e478ecb37fc",
    18: "1044b8d0f8008482",
    19: "0b0c4e83d27cec80",
}
"""`schema_digest()` by schema version. Never change an entry: add one with the next number."""
SCHEMA_VERSION = max(SCHEMA_DIGESTS)
ADDED: dict[int, dict[str, tuple[str, ...]]] = {
    18: {"trips": ("stops", "co2_g")},
    19: {"requests": ("wait_sim_ns",)},
}
"""Columns at the end of tables, by the schema version that added them: in runs of older versions,
down to the one before the first of these, they are read as NULL."""
_SQL_TYPES = {int: "INTEGER", float: "REAL", str: "TEXT", bytes: "BLOB"}


class MetaRow(NamedTuple):
    """A fact about the whole run."""

    key: str
    value: str


class FrameRow(NamedTuple):
    """One frame of all regions; NULL is what was never received.

    `vehicles` are all in the net. `agents` are those of which data arrived in time, a pose at
    least, and was not excluded, also in several regions; `points` are those of their scans.
    `detections` leave out coasted vehicles, which the table `detections` also holds. `complete` is
    1 if in each region all announced data had arrived; request and end-to-end time are those of the
    last region.
    """

    frame: int
    sim_time_ns: int | None
    vehicles: int | None
    cavs: int | None
    cvs: int | None
    agents: int | None
    points: int | None
    detections: int | None
    complete: int | None
    tick_ns: int | None
    request_ns: int | None
    end_to_end_ns: int | None


class RegionFrameRow(NamedTuple):
    """One frame of one region; NULL is what was never received.

    `border_bytes` were sent to neighbouring regions, `end_to_end_ns` ends with its last cabinet.
    """

    frame: int
    region: str
    agents: int | None
    points: int | None
    detections: int | None
    complete: int | None
    border_bytes: int | None
    request_ns: int | None
    end_to_end_ns: int | None


class UploadRow(NamedTuple):
    """One chunk: metrics of its sender (`link_sim_ns` on a virtual link), then of the edge.

    `wire_bytes` and `wire_received_bytes` stand in one row of an agent's frame: all bytes on its
    link in it, up and down, as IP packets. They are known when the next frame begins: the last
    one's are NULL. In a run within one process a chunk is received while it is sent, so that
    `received_ns` lies before `sent_ns`; on a virtual link it takes `link_sim_ns`.
    """

    frame: int
    region: str
    agent: str
    chunk: int
    points: int | None
    payload_bytes: int | None
    wire_bytes: int | None
    wire_received_bytes: int | None
    sense_start_ns: int | None
    sense_end_ns: int | None
    encode_end_ns: int | None
    sent_ns: int | None
    link_sim_ns: int | None
    received_ns: int | None
    decoded_ns: int | None


class StageRow(NamedTuple):
    """One stage of one frame in one process, for an agent, a signal (its id there) or for all."""

    frame: int
    process: str
    agent: str
    stage: str
    start_ns: int
    duration_ns: int


class LatencyRow(NamedTuple):
    """Latency breakdown of a frame for one agent in a region; stages sum to `end_to_end_ns`."""

    frame: int
    region: str
    agent: str
    sense_ns: int
    select_ns: int
    encode_ns: int
    send_ns: int
    link_ns: int
    decode_ns: int
    place_ns: int
    wait_ns: int
    check_ns: int
    merge_ns: int
    ground_ns: int
    detect_ns: int
    fuse_ns: int
    border_ns: int
    track_ns: int
    count_ns: int
    decide_ns: int
    actuate_ns: int
    other_ns: int
    end_to_end_ns: int
    clock_error_ns: int


class DetectionRow(NamedTuple):
    """One vehicle known to a region's edge: its box's centre, size, heading in the map frame.

    `object_class` is of `protocol.messages.ObjectClass`. `track` is the vehicle's id from frame to
    frame, unique in the run's city, 0 without tracking. `coasted_s` is the time since a sensor last
    saw it, 0 if one did in this frame; of others the position is predicted, and `score` is the
    probability that the vehicle is there. A new track's `speed_mps` is its lane's limit, or that of
    the vehicle beside it, and `speed_std_mps` is accordingly large.
    """

    frame: int
    region: str
    detection: int
    x_m: float
    y_m: float
    z_m: float
    length_m: float
    width_m: float
    height_m: float
    yaw_rad: float
    score: float
    object_class: int
    lane: str
    distance_m: float
    source: str
    track: int = 0
    speed_mps: float = 0.0
    coasted_s: float = 0.0
    position_std_m: float = 0.0
    speed_std_mps: float = 0.0


class CountRow(NamedTuple):
    """Vehicles counted on a lane for a signal; `side` is "upstream" or "downstream" of its bar.

    Those of them that stand still are `queued`, those that no sensor saw in this frame `coasted`.
    """

    frame: int
    tls: str
    lane: str
    side: str
    vehicles: int
    queued: int
    coasted: int = 0


class PhaseRow(NamedTuple):
    """The signal's state, and the source of the request for it."""

    frame: int
    tls: str
    sim_time_ns: int
    state: str
    stage: str
    green: str
    source: str


class RequestRow(NamedTuple):
    """A policy's request; `pressures` is a JSON list in vehicles.

    `delay_sim_ns`, with virtual links: how long after the frame's time it reached the cabinet.
    `unknown`: lanes without coverage, whose vehicles were estimated, separated by spaces.
    `wait_sim_ns`: for how long after the frame's time what was requested before holds.
    """

    frame: int
    tls: str
    state: str
    policy: str
    pressures: str
    delay_sim_ns: int | None
    unknown: str
    wait_sim_ns: int | None


class TruthRow(NamedTuple):
    """Ground truth of a vehicle or pedestrian: footprint centre on the ground, in the map frame.

    `lane` is empty for those off the road; `type` is one of `vehicle_types`.
    """

    frame: int
    vehicle: str
    type: str
    equipment: int
    x_m: float
    y_m: float
    z_m: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    speed_mps: float
    lane: str
    lane_position_m: float


class VehicleTypeRow(NamedTuple):
    """A type of bodies in `truth` and `parked`, and the class that detectors should give it.

    `object_class` is of `protocol.messages.ObjectClass`, as that of detections.
    """

    type: str
    object_class: int
    length_m: float
    width_m: float
    height_m: float


class ParkedRow(NamedTuple):
    """A parked car: footprint centre on the ground, in the map frame. `truth` has no row of it."""

    vehicle: str
    type: str
    x_m: float
    y_m: float
    z_m: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float


class SightingRow(NamedTuple):
    """Points of an agent's scan by the vehicle that they lay on, as JSON."""

    frame: int
    agent: str
    points: str


class AgentScoreRow(NamedTuple):
    """Misbehaviour score of an agent; a row when it changed, and while the agent is excluded.

    `score` is a mean over frames; the others are of this frame alone, NULL where there was nothing
    to check.
    """

    frame: int
    region: str
    agent: str
    score: float
    trusted: int
    motion: float | None
    place: float | None
    ground: float | None


class AlignmentRow(NamedTuple):
    """Pose error of an agent, as an edge estimates it, in frames in which its scan was used.

    The offset is the claimed pose minus the found one; `std_m` is of x and of y, the larger. Of the
    scan's `points` where the edge's static map has data, the share `inliers` fits it.
    """

    frame: int
    region: str
    agent: str
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    std_m: float
    points: int
    inliers: float
    excluded: int


class TripRow(NamedTuple):
    """One vehicle's journey; `arrive_s` is NULL if the run ended before it did.

    `stops` and `co2_g` are NULL in a run that was recorded before they were.
    """

    vehicle: str
    equipment: int
    depart_s: float
    arrive_s: float | None
    time_loss_s: float
    teleported: int
    stops: int | None
    co2_g: float | None


class ClockRow(NamedTuple):
    """Offset from a process's clock to that of the world's host, at the end of the run."""

    process: str
    offset_ns: int
    error_ns: int


class DropRow(NamedTuple):
    """How often a process dropped input for one reason, since its start."""

    process: str
    reason: str
    times: int


class GapRow(NamedTuple):
    """Messages between these frames may be missing, all or some.

    `away` was the recorder itself, or the router of a bus: `recorder`, `v2x` or `world`.
    `after_frame` is the last with a request before the gap, `until_frame` the first with a message
    after it.
    """

    after_frame: int
    away: str
    until_frame: int


class CloudRow(NamedTuple):
    """One upload of a snapshot frame, as published on the bus; `sensor_*` is `map_SE3_sensor`."""

    frame: int
    region: str
    agent: str
    chunk: int
    points: int
    sensor_x_m: float
    sensor_y_m: float
    sensor_z_m: float
    sensor_roll_rad: float
    sensor_pitch_rad: float
    sensor_yaw_rad: float
    payload: bytes


@dataclass(frozen=True)
class Table:
    """A table: its row type, how many leading columns identify a row, and how it is stored.

    `is_result` marks tables that hold no times of a real clock and no measured bytes, so that two
    lockstep runs of one scenario and seed agree in every row.
    """

    name: str
    row: type[Any]
    keys: int
    is_result: bool = False
    rowid: bool = False

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Column names in row order."""
        return tuple(self.row._fields)

    @cached_property
    def create(self) -> str:
        """The statement that makes the table."""
        parts = [f"{name} {sql}" for name, sql in zip(self.columns, self._types, strict=True)]
        if self.keys:
            parts.append(f"PRIMARY KEY ({', '.join(self.columns[: self.keys])})")
        storage = "" if self.rowid or not self.keys else " WITHOUT ROWID"
        return f"CREATE TABLE {self.name} ({', '.join(parts)}){storage}"

    @cached_property
    def insert(self) -> str:
        """The statement that writes a row; a row with the same keys is replaced."""
        marks = ", ".join("?" * len(self.columns))
        return f"INSERT OR REPLACE INTO {self.name} VALUES ({marks})"

    @cached_property
    def select(self) -> str:
        """The statement that reads all rows, in the order of their keys."""
        order = ", ".join(self.columns[: self.keys]) or "rowid"
        return f"SELECT {', '.join(self.columns)} FROM {self.name} ORDER BY {order}"

    @property
    def _types(self) -> list[str]:
        hints = get_type_hints(self.row)
        return [_sql_type(hints[name]) for name in self.columns]


def _sql_type(hint: object) -> str:
    kinds = get_args(hint) or (hint,)
    optional = type(None) in kinds
    kind = next(k for k in kinds if k is not type(None))
    return _SQL_TYPES[kind] + ("" if optional else " NOT NULL")


TABLES: dict[type, Table] = {
    table.row: table
    for table in (
        Table("meta", MetaRow, 1),
        Table("frames", FrameRow, 1),
        Table("region_frames", RegionFrameRow, 2),
        Table("uploads", UploadRow, 4),
        Table("stages", StageRow, 0),
        Table("latency", LatencyRow, 3),
        Table("detections", DetectionRow, 3, is_result=True),
        Table("counts", CountRow, 4, is_result=True),
        Table("phases", PhaseRow, 2, is_result=True),
        Table("requests", RequestRow, 2, is_result=True),
        Table("truth", TruthRow, 2, is_result=True),
        Table("vehicle_types", VehicleTypeRow, 1, is_result=True),
        Table("parked", ParkedRow, 1, is_result=True),
        Table("sightings", SightingRow, 2, is_result=True),
        Table("agent_scores", AgentScoreRow, 3, is_result=True),
        Table("alignments", AlignmentRow, 3, is_result=True),
        Table("trips", TripRow, 1, is_result=True),
        Table("clocks", ClockRow, 1),
        Table("drops", DropRow, 2),
        Table("gaps", GapRow, 2),
        Table("clouds", CloudRow, 4, rowid=True),
    )
}
"""Every table by its row type."""


def schema_digest() -> str:
    """Returns a digest of all tables with their columns, types and keys, in order."""
    statements = "\n".join(table.create for table in TABLES.values())
    return hashlib.sha256(statements.encode()).hexdigest()[:16]
