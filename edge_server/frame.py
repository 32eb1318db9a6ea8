"""Frames and chunks in the pipeline, their state, and the interface of a stage.

Chunks and frames are ordered by agent, not by arrival. A stage works on one chunk, in any thread as
soon as the chunk has arrived, or on the state of a whole frame.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from edge_server.coverage import SensorViews
from edge_server.lanes import LanePositions
from perception.arrays import Bytes, Floats, Floats32
from perception.detector import Cloud, Vehicles
from perception.roadway import Placed
from perception.tracking.tracks import Tracks
from protocol.messages import (
    AgentAlignment,
    AgentPose,
    AgentScore,
    BorderObjects,
    Detections,
    LaneCounts,
    Objects,
    Scan,
    Span,
)


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """One chunk of a scan; each chunk stage returns it with more filled in.

    `points` (N, 3) are in the sensor frame, from the decoding of the `payload` on until they are
    `placed` in the map frame. `sensor_pose` (6,) is `map_SE3_sensor` as the agent estimates it. For
    `plan_frame` and `ground_free` see `protocol.messages.Scan`. `size_bytes` is that of the
    payload, `returns` the number of points it held. `structure` (M, 3) are the static points beside
    the road, in frames in which they are extracted (`edge_server.static_map.structure`). `spans`
    are those of the stages that it has passed, in their order. A chunk that `is_undecodable` did
    arrive, but has no points.
    """

    frame: int
    sim_time_ns: int
    agent: str
    index: int
    chunk_count: int
    sensor_pose: Floats
    points: Floats32
    received_ns: int
    payload: Bytes | None = None
    plan_frame: int = -1
    ground_free: bool = False
    arrival_sim_ns: int | None = None
    size_bytes: int = 0
    structure: Floats32 | None = None
    placed: Placed | None = None
    returns: int = 0
    is_undecodable: bool = False
    spans: tuple[Span, ...] = ()

    @classmethod
    def of(cls, scan: Scan, received_ns: int) -> Chunk:
        """Returns a chunk as it arrived, not decoded yet."""
        return cls(
            frame=scan.frame,
            sim_time_ns=scan.sim_time_ns,
            agent=scan.agent,
            index=scan.chunk,
            chunk_count=scan.chunks,
            sensor_pose=scan.sensor_pose,
            points=np.zeros((0, 3), np.float32),
            received_ns=received_ns,
            payload=scan.payload,
            plan_frame=scan.plan_frame,
            ground_free=scan.ground_free,
            arrival_sim_ns=scan.arrival_sim_ns,
            size_bytes=scan.payload.size,
        )

    @classmethod
    def undecodable(cls, scan: Scan, received_ns: int) -> Chunk:
        """Returns a chunk without points in place of one that cannot be decoded."""
        return replace(cls.of(scan, received_ns), payload=None, is_undecodable=True)

    @property
    def decoded_ns(self) -> int:
        """When its first stage, decoding, ended."""
        return self.spans[0].end_ns if self.spans else self.received_ns


@dataclass(frozen=True, slots=True, eq=False)
class AgentDetections:
    """Boxes that an agent detected on board, and when they arrived."""

    objects: Objects
    received_ns: int

    @property
    def agent(self) -> str:
        """The agent that detected them."""
        return self.objects.agent

    @property
    def arrival_sim_ns(self) -> int | None:
        """When they arrived over a virtual link."""
        return self.objects.arrival_sim_ns


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The received parts of a frame. `complete` tells whether all needed parts arrived.

    `agents`, `poses` and `found` are sorted by agent, `chunks` by agent and index. The first part
    arrived at `first_ns`; waiting ended at `ready_ns`. `scanning` are the agents, sorted, that
    announced a scan, whether it arrived or not. `delay_sim_ns` is known where links are virtual.
    `signals` are the signals' states before it: by id a letter for each light. `cells` (V, 2) are
    the convex parts of the scene that agents' chunks are of, where they are not all that they see.
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
    signals: Mapping[str, str] = field(default_factory=dict)
    cells: Mapping[str, Floats] = field(default_factory=dict)

    def without(self, excluded: set[str]) -> Frame:
        """Returns the frame without the data of some agents."""
        if not excluded:
            return self
        return replace(
            self,
            agents=[agent for agent in self.agents if agent not in excluded],
            poses=[pose for pose in self.poses if pose.agent not in excluded],
            chunks=[chunk for chunk in self.chunks if chunk.agent not in excluded],
            found=[one for one in self.found if one.agent not in excluded],
        )


@dataclass(slots=True, eq=False)
class FrameState:
    """State of one frame in the pipeline; each stage reads what earlier ones have filled in.

    A field that no stage has filled in yet raises AttributeError. `frame` begins with all that
    arrived; `received` are the border messages of neighbouring regions, by region. `fused` are
    vehicles in this frame, wherever they are, `tracks` those followed over frames, on the road once
    they are counted, at their lane `positions`. `sensors` are those that were used, `counts` are by
    signal. `excluded` counts the agents that were excluded from it, by reason, `distrusted` names
    them, `drops` counts what else was left out, and `scores` and `alignments` are those to be
    published.
    """

    frame: Frame
    excluded: Counter[str] = field(default_factory=Counter)
    distrusted: set[str] = field(default_factory=set)
    scores: list[AgentScore] = field(default_factory=list)
    alignments: list[AgentAlignment] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)
    drops: Counter[str] = field(default_factory=Counter)
    cloud: Cloud = field(init=False)
    found: Vehicles = field(init=False)
    fused: Vehicles = field(init=False)
    sensors: SensorViews = field(init=False)
    received: dict[str, BorderObjects] = field(default_factory=dict)
    tracks: Tracks = field(init=False)
    positions: LanePositions = field(init=False)
    detections: Detections = field(init=False)
    counts: dict[str, LaneCounts] = field(init=False)

    @property
    def points(self) -> int:
        """How many points the chunks held that were used."""
        return sum(chunk.returns for chunk in self.frame.chunks)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Context manager that records a span, or the parts that it is divided into."""
        start_ns, already = time.monotonic_ns(), len(self.spans)
        yield
        if len(self.spans) == already:
            self.spans.append(Span(stage=name, start_ns=start_ns, end_ns=time.monotonic_ns()))


class ChunkStage(ABC):
    """A stage that needs one chunk alone; it is stateless, any thread may run it."""

    name: ClassVar[str]

    @abstractmethod
    def run(self, chunk: Chunk) -> Chunk:
        """Returns the chunk with this stage's part filled in."""


class FrameStage(ABC):
    """A stage that needs the whole frame. It may keep state.

    Frames pass in the order of their time, one after the other.
    """

    name: ClassVar[str]

    @abstractmethod
    def run(self, state: FrameState) -> None:
        """Fills in this stage's part."""


Stage = ChunkStage | FrameStage


def sensor_places(chunks: Sequence[Chunk]) -> Floats:
    """Returns where the sensors of chunks stand (S, 3), map frame."""
    return np.array([chunk.sensor_pose[:3] for chunk in chunks]).reshape(-1, 3)
