"""The way of a frame, from payloads to counts per lane (Chen et al. 2022), as a list of stages.

    decode, place      each chunk by itself, in any thread, as soon as it has arrived
    check              excludes agents whose data cannot be so; remembers scores
    merge              one cloud of all that are left
    detect             a detector's vehicles; it names parts of its own, such as ground
    fuse               with agents' poses and detections; no duplicates, none off the road
    count              per lane; remembers where vehicles were, to tell which are stationary

Each stage is entered once and fills in its part of the frame's state. A stage is added by adding it
to the list; its span follows from its name. Nothing here knows a network.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.frame import (
    Chunk,
    ChunkStage,
    Frame,
    FrameStage,
    FrameState,
    Stage,
    sensor_places,
)
from edge_server.fusion import fuse
from edge_server.lanes import CoverageShares, LaneCoverage, LaneIndex
from edge_server.misbehaviour import Check
from edge_server.placing import Decode, Place, PlaceByReference
from edge_server.stationary import StationaryVehicles
from perception.arrays import Floats
from perception.detector import Cloud, Detector, DetectorMaker, Vehicles
from perception.registry import detector_of
from perception.roadway import Roadway
from protocol.messages import Detections, LaneCounts, Scan, Span
from protocol.roadmap import RoadMap


class Pipeline:
    """Runs stages in their order: those of chunks, then those of the frame."""

    def __init__(self, stages: Sequence[Stage]) -> None:
        """Takes the stages.

        Raises:
            ValueError: two have one name, or a chunk's stage follows a frame's.
        """
        names = [stage.name for stage in stages]
        self.stages = tuple(stages)
        self._of_chunk = [stage for stage in stages if isinstance(stage, ChunkStage)]
        self._of_frame = [stage for stage in stages if isinstance(stage, FrameStage)]
        if len(set(names)) < len(names) or [*self._of_chunk, *self._of_frame] != [*stages]:
            raise ValueError(f"stages {names}: each name once, stages of chunks first")

    @classmethod
    def of(
        cls,
        road_map: RoadMap,
        config: EdgeConfig,
        *,
        seed: int,
        detector: DetectorMaker = detector_of,
        has_lidars: bool = True,
        mounts: Mapping[str, Floats] | None = None,
    ) -> Pipeline:
        """Returns the pipeline of a scenario; for the arguments see `stages_of`."""
        stages = stages_of(
            road_map, config, seed=seed, detector=detector, has_lidars=has_lidars, mounts=mounts
        )
        return cls(stages)

    def open(self, scan: Scan, received_ns: int) -> Chunk:
        """Runs the stages of one chunk; for any thread.

        Raises:
            CodecError: the payload is not a scan.
        """
        return self.prepare(Chunk.of(scan, received_ns))

    def prepare(self, chunk: Chunk) -> Chunk:
        """Runs those stages of a chunk that it has not passed."""
        for stage in self._of_chunk[len(chunk.spans) :]:
            start_ns = time.monotonic_ns()
            chunk = stage.run(chunk)
            span = Span(
                stage=stage.name,
                agent=chunk.agent,
                start_ns=start_ns,
                end_ns=time.monotonic_ns(),
            )
            chunk = replace(chunk, spans=(*chunk.spans, span))
        return chunk

    def run(self, frame: Frame) -> FrameState:
        """Runs the stages of a frame, after those that its chunks have not passed."""
        chunks = [self.prepare(chunk) for chunk in frame.chunks]
        state = FrameState(replace(frame, chunks=chunks))
        for stage in self._of_frame:
            with state.timed(stage.name):
                stage.run(state)
        return state


def stages_of(
    road_map: RoadMap,
    config: EdgeConfig,
    *,
    seed: int,
    detector: DetectorMaker = detector_of,
    has_lidars: bool = True,
    mounts: Mapping[str, Floats] | None = None,
) -> list[Stage]:
    """Returns the stages of a scenario.

    Args:
        road_map: the region's roads.
        config: the scenario's section `edge`.
        seed: of the scenario.
        detector: makes the detector.
        has_lidars: whether any agent is meant to send what its LiDAR measures.
        mounts: by agent x, y and yaw (3,) of the roadside units' mounts, map frame.
    """
    mounts = mounts or {}
    roadway = Roadway.of(road_map, margin_m=config.geofence.margin_m)
    lanes = LaneIndex(road_map)
    place = Place(roadway, config.geofence)
    check = [Check(road_map, roadway, config.misbehaviour, mounts)]
    return [
        Decode(),
        place if config.merge == "se3" else PlaceByReference(place),
        *(check if config.misbehaviour.enabled else []),
        Merge(),
        Detect(detector(config, roadway), seed),
        Fuse(lanes, config, np.array(road_map.centre)),
        Count(road_map, lanes, config, mounts, has_lidars=has_lidars),
    ]


class Merge(FrameStage):
    """Brings all chunks together, those with ground in them and those without apart."""

    name = "merge"

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        near, bare = (
            [c.placed for c in state.frame.chunks if c.placed and c.ground_free is is_bare]
            for is_bare in (False, True)
        )
        state.cloud = Cloud(near, bare, sensor_places(state.frame.chunks))


class Detect(FrameStage):
    """Finds vehicles in the cloud; a detector divides this stage into parts that it names."""

    name = "detect"

    def __init__(self, detector: Detector, seed: int) -> None:
        self._detector = detector
        self._seed = [seed, zlib.crc32(b"ground")]

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        rng = np.random.default_rng([*self._seed, state.frame.frame])
        state.found = self._detector.detect(state.cloud, rng, state.timed)


class Fuse(FrameStage):
    """Joins detections of the cloud, of agents, and agents' poses; keeps vehicles on the road."""

    name = "fuse"

    def __init__(self, lanes: LaneIndex, config: EdgeConfig, centre: Floats) -> None:
        self._lanes = lanes
        self._config = config
        self._centre = centre

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        config, found = self._config, state.found
        for objects in (one.objects for one in state.frame.found):
            found += Vehicles.from_lidar(
                objects.boxes.astype(np.float64), objects.scores.astype(np.float64)
            )
        vehicles = fuse(found, state.frame.poses, centre=self._centre, config=config.fusion)
        positions = self._lanes.locate(
            vehicles.boxes, margin_m=config.geofence.margin_m + vehicles.position_std_m
        )
        on_road = positions.lane >= 0
        state.vehicles, state.positions = vehicles.take(on_road), positions.take(on_road)


class Count(FrameStage):
    """Counts vehicles and queues per lane, says what sensors cover; remembers recent positions."""

    name = "count"

    def __init__(
        self,
        road_map: RoadMap,
        lanes: LaneIndex,
        config: EdgeConfig,
        mounts: Mapping[str, Floats],
        *,
        has_lidars: bool,
    ) -> None:
        self._tls = road_map.signal.tls
        self._lanes = lanes
        self._config = config
        self._mounts = mounts
        self._has_lidars = has_lidars
        self._coverage = LaneCoverage(
            road_map, lanes, upstream_m=config.upstream_m, downstream_m=config.downstream_m
        )
        self._stationary = StationaryVehicles(config.stationary_mps)

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        state.detections = self._detections(state)
        state.counts = self._counts(state)

    def _detections(self, state: FrameState) -> Detections:
        frame, vehicles = state.frame, state.vehicles
        return Detections(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            agents=frame.agents,
            boxes=vehicles.boxes.astype(np.float32),
            scores=vehicles.scores.astype(np.float32),
            lanes=self._lanes.names(state.positions),
            distances_m=self._lanes.distances_m(state.positions).astype(np.float32),
            sources=vehicles.sources,
        )

    def _counts(self, state: FrameState) -> LaneCounts:
        frame, config = state.frame, self._config
        stationary = self._stationary.mark(frame.sim_time_ns, state.vehicles.boxes[:, :2])
        (upstream, downstream), (stationary_upstream, stationary_downstream) = (
            self._lanes.count(part, upstream_m=config.upstream_m, downstream_m=config.downstream_m)
            for part in (state.positions, state.positions.take(stationary))
        )
        coverage_upstream, coverage_downstream = self._covered(frame)
        return LaneCounts(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            tls=self._tls,
            agents=frame.agents,
            complete=frame.complete,
            upstream=upstream,
            downstream=downstream,
            stationary_upstream=stationary_upstream,
            stationary_downstream=stationary_downstream,
            coverage_upstream=coverage_upstream,
            coverage_downstream=coverage_downstream,
            delay_sim_ns=frame.delay_sim_ns,
        )

    def _covered(self, frame: Frame) -> tuple[CoverageShares, CoverageShares]:
        """Returns how much of each lane was covered by sensors whose scan or boxes arrived.

        Where there are LiDARs, a frame to which none contributed covers nothing. Where there are
        none, vehicles report themselves alone, and coverage means nothing.
        """
        if not self._has_lidars:
            return {}, {}
        scans = sensor_places([chunk for chunk in frame.chunks if not chunk.is_undecodable])
        places_m = np.concatenate([scans[:, :2], self._detecting_agents(frame)])
        return self._coverage.shares(places_m, self._config.coverage_range_m)

    def _detecting_agents(self, frame: Frame) -> Floats:
        """Returns where the agents stand (N, 2) that sent boxes, as far as that is known."""
        places = {name: place[:2] for name, place in self._mounts.items()}
        places |= {pose.agent: pose.pose[:2] for pose in frame.poses}
        known = [places[one.agent] for one in frame.found if one.agent in places]
        return np.array(known).reshape(-1, 2)
