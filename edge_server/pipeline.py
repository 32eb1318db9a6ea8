"""The edge pipeline, from payloads to counts per lane (Chen et al. 2022), as a list of stages.

    decode, place      each chunk by itself, in any thread, as soon as it has arrived
    sample             where poses are aligned: thins a chunk's points, as decode does
    check              excludes misbehaving agents; keeps scores
    align              where configured: corrects agents' poses; keeps the static map and offsets
    merge              one cloud of all remaining chunks
    detect             vehicles by the detector; it names parts of its own, such as ground
    fuse               with agents' poses and detections; no duplicates
    border             with detections of neighbouring regions on the lanes that both have
    track              gives vehicles ids and speeds; keeps those that no sensor sees now
    count              on the road, per lane

`begin` runs the stages up to what neighbours are sent, `finish` those after it. Each stage is
entered once and fills in its part of the frame's state. A stage is added by adding it to the list;
its span follows from its name. Nothing here uses a network.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from edge_server.border import BORDER, BorderStrips
from edge_server.config import EdgeConfig, FusionConfig
from edge_server.coverage import Covered, LaneCoverage, SensorViews
from edge_server.frame import (
    Chunk,
    ChunkStage,
    Frame,
    FrameStage,
    FrameState,
    Stage,
    sensor_places,
)
from edge_server.fusion import Fusion, fusion_of
from edge_server.lanes import LaneIndex
from edge_server.misbehaviour import Check
from edge_server.placing import Decode, Place, PlaceByReference
from edge_server.tracking import Track
from perception.arrays import Bools, Floats
from perception.detector import LIDAR, Cloud, Detector, DetectorMaker, Vehicles
from perception.map_height import on_the_ground
from perception.object_classes import passenger_car_units
from perception.registry import detector_of
from perception.roadway import Roadway
from protocol.messages import Detections, LaneCounts, ObjectClass, Scan, Span
from protocol.regions import RegionMap

SPEED_KNOWN_NS = 500_000_000
"""Age, s, from which on a track's speed is reliable."""


class Pipeline:
    """Runs the stages in order: those of chunks, then those of the frame."""

    def __init__(self, stages: Sequence[Stage]) -> None:
        """Takes the stages.

        Raises:
            ValueError: two have one name, or a chunk's stage follows a frame's.
        """
        names = [stage.name for stage in stages]
        self.stages = tuple(stages)
        self._of_chunk = [stage for stage in stages if isinstance(stage, ChunkStage)]
        self._of_frame = [stage for stage in stages if isinstance(stage, FrameStage)]
        of_frame = [stage.name for stage in self._of_frame]
        self._border = of_frame.index(BORDER) if BORDER in of_frame else len(of_frame)
        if len(set(names)) < len(names) or [*self._of_chunk, *self._of_frame] != [*stages]:
            raise ValueError(f"stages {names}: each name once, stages of chunks first")

    @classmethod
    def of(
        cls,
        region: RegionMap,
        config: EdgeConfig,
        *,
        seed: int,
        detector: DetectorMaker = detector_of,
        has_lidars: bool = True,
        mounts: Mapping[str, Floats] | None = None,
        strips: BorderStrips | None = None,
    ) -> Pipeline:
        """Returns the pipeline of a region; for the arguments see `stages_of`."""
        stages = stages_of(
            region,
            config,
            seed=seed,
            detector=detector,
            has_lidars=has_lidars,
            mounts=mounts,
            strips=strips,
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
        return self.finish(self.begin(frame))

    def begin(self, frame: Frame) -> FrameState:
        """Runs the stages of a frame up to the border message."""
        chunks = [self.prepare(chunk) for chunk in frame.chunks]
        state = FrameState(replace(frame, chunks=chunks))
        for stage in self._of_frame[: self._border]:
            with state.timed(stage.name):
                stage.run(state)
        return state

    def finish(self, state: FrameState) -> FrameState:
        """Runs the other stages, once `received` is filled in."""
        for stage in self._of_frame[self._border :]:
            with state.timed(stage.name):
                stage.run(state)
        return state


def stages_of(
    region: RegionMap,
    config: EdgeConfig,
    *,
    seed: int,
    detector: DetectorMaker = detector_of,
    has_lidars: bool = True,
    mounts: Mapping[str, Floats] | None = None,
    strips: BorderStrips | None = None,
) -> list[Stage]:
    """Returns the stages of a scenario.

    Args:
        region: the region's roads.
        config: the scenario's section `edge`.
        seed: of the scenario.
        detector: makes the detector.
        has_lidars: whether any agent is configured to send LiDAR data.
        mounts: by agent x, y and yaw (3,) of the roadside units' mounts, map frame.
        strips: those between the region and its neighbours, if it has any.
    """
    mounts = mounts or {}
    roadway = Roadway.of(region.area, margin_m=config.geofence.margin_m)
    lanes = LaneIndex(region.surroundings)
    place = Place(roadway, config.geofence)
    sample, align = _alignment(roadway, config, mounts)
    check = [Check(region, roadway, config.misbehaviour, mounts)]
    return [
        Decode(),
        *sample,
        place if config.merge == "se3" else PlaceByReference(place),
        *(check if config.misbehaviour.enabled else []),
        *align,
        Merge(),
        Detect(detector(config, roadway), seed),
        Fuse(fusion_of(config.fusion, region.centres), mounts),
        *([Border(strips, config.fusion)] if strips is not None else []),
        Track(region.surroundings, config.tracking, strips),
        Count(region, lanes, config, has_lidars=has_lidars, strips=strips),
    ]


def _alignment(
    roadway: Roadway, config: EdgeConfig, mounts: Mapping[str, Floats]
) -> tuple[list[ChunkStage], list[FrameStage]]:
    """Returns the stages that align agents; the registration is loaded where they are wanted."""
    if config.alignment == "none":
        return [], []
    from edge_server.alignment import Align, Sample

    return [Sample(roadway)], [Align(mounts)]


class Merge(FrameStage):
    """Merges all chunks to one cloud, those with and without ground separately."""

    name = "merge"

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        placed = [(c, c.placed) for c in state.frame.chunks if c.placed is not None]
        near = [(c, part) for c, part in placed if not c.ground_free]
        bare = [(c, part) for c, part in placed if c.ground_free]
        cloud = Cloud(
            [part for _, part in near],
            [part for _, part in bare],
            sensor_places([chunk for chunk, _ in near + bare]),
        )
        state.cloud = on_the_ground(cloud)


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
    """Joins detections of the cloud, of agents, and agents' poses."""

    name = "fuse"

    def __init__(self, fusion: Fusion, mounts: Mapping[str, Floats]) -> None:
        self._fusion = fusion
        self._mounts = mounts

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        found = state.found
        for objects in (one.objects for one in state.frame.found):
            found += Vehicles.from_lidar(
                objects.boxes.astype(np.float64),
                objects.scores.astype(np.float64),
                objects.classes,
            )
        state.fused = self._fusion.fuse(found, state.frame.poses)
        chunks = [chunk for chunk in state.frame.chunks if not chunk.is_undecodable]
        cells = [state.frame.cells.get(chunk.agent) for chunk in chunks]
        scans = SensorViews.of(sensor_places(chunks)[:, :2], cells)
        state.sensors = scans.and_whole(self._detecting_agents(state.frame))

    def _detecting_agents(self, frame: Frame) -> Floats:
        """Returns the known positions (N, 2) of the agents that sent boxes."""
        places = {name: place[:2] for name, place in self._mounts.items()}
        places |= {pose.agent: pose.pose[:2] for pose in frame.poses}
        known = [places[one.agent] for one in frame.found if one.agent in places]
        return np.array(known).reshape(-1, 2)


class Border(FrameStage):
    """Fuses the region's vehicles with those of its neighbours in the border strips."""

    name = BORDER

    def __init__(self, strips: BorderStrips, config: FusionConfig) -> None:
        self._strips = strips
        self._config = config

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        self._strips.join(state, self._config)


class Count(FrameStage):
    """Keeps vehicles on the road; counts vehicles and queues per lane and what sensors cover."""

    name = "count"

    def __init__(
        self,
        region: RegionMap,
        lanes: LaneIndex,
        config: EdgeConfig,
        *,
        has_lidars: bool,
        strips: BorderStrips | None = None,
    ) -> None:
        self._strips = strips
        self._owned = {"", *region.area.by_tls}
        self._lanes = lanes
        self._config = config
        self._has_lidars = has_lidars
        reach = {"upstream_m": config.upstream_m, "downstream_m": config.downstream_m}
        self._coverage = {
            tls: LaneCoverage(region.surroundings, around, **reach)
            for tls, around in lanes.approaches.items()
        }

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        tracks = state.tracks
        reports_itself = np.array([source != LIDAR for source in tracks.sources], np.bool_)
        margin_m = self._config.geofence.margin_m + tracks.position_std_m * reports_itself
        positions = self._lanes.locate(tracks.boxes, margin_m=margin_m)
        on_road = positions.lane >= 0
        state.tracks, state.positions = tracks.take(on_road), positions.take(on_road)
        state.detections = self._detections(state)
        if self._strips is not None:
            self._strips.note(state.detections)
        counts = state.tracks.classes != ObjectClass.PEDESTRIAN
        state.tracks, state.positions = state.tracks.take(counts), state.positions.take(counts)
        state.counts = {tls: self._counts(state, tls) for tls in self._coverage}

    def _detections(self, state: FrameState) -> Detections:
        """Returns the tracks on lanes of this region; their owners publish others."""
        owners = self._lanes.owners(state.positions)
        own = np.array([tls in self._owned for tls in owners], np.bool_)
        frame, tracks, positions = state.frame, state.tracks.take(own), state.positions.take(own)
        return Detections(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            agents=frame.agents,
            boxes=tracks.boxes.astype(np.float32),
            scores=tracks.scores.astype(np.float32),
            classes=tracks.classes,
            lanes=self._lanes.names(positions),
            distances_m=self._lanes.distances_m(positions).astype(np.float32),
            sources=tracks.sources,
            track_ids=tracks.track_ids,
            speeds_mps=tracks.speeds_mps,
            coasted_s=tracks.coasted_s,
            ages_s=(frame.sim_time_ns - tracks.first_seen_ns) / 1e9,
            position_std_m=tracks.position_std_m,
            speed_std_mps=tracks.speed_std_mps,
        )

    def _counts(self, state: FrameState, tls: str) -> LaneCounts:
        frame, config, positions = state.frame, self._config, state.positions
        reach = {"upstream_m": config.upstream_m, "downstream_m": config.downstream_m}
        upstream, downstream = self._lanes.count(positions, tls, **reach)
        stationary_upstream, stationary_downstream = self._lanes.count(
            positions.take(self._is_stationary(state)), tls, **reach
        )
        coasted_upstream, coasted_downstream = self._lanes.count(
            positions.take(state.tracks.coasted_s > 0), tls, **reach
        )
        units = passenger_car_units(state.tracks.classes)
        pcu_upstream, pcu_downstream = self._lanes.weigh(positions, units, tls, **reach)
        covered = self._covered(state, tls)
        return LaneCounts(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            tls=tls,
            agents=frame.agents,
            complete=frame.complete,
            upstream=upstream,
            downstream=downstream,
            stationary_upstream=stationary_upstream,
            stationary_downstream=stationary_downstream,
            pcu_upstream={lane: round(value, 1) for lane, value in pcu_upstream.items()},
            pcu_downstream={lane: round(value, 1) for lane, value in pcu_downstream.items()},
            coasted_upstream=coasted_upstream,
            coasted_downstream=coasted_downstream,
            coverage_upstream=covered.upstream,
            coverage_downstream=covered.downstream,
            coverage_from_bar=covered.from_bar,
            delay_sim_ns=frame.delay_sim_ns,
        )

    def _is_stationary(self, state: FrameState) -> Bools:
        """Marks the tracks slower than the limit; of a new one, the speed is not known yet."""
        tracks, limit_mps = state.tracks, self._config.stationary_mps
        is_known = state.frame.sim_time_ns - tracks.first_seen_ns >= SPEED_KNOWN_NS
        return np.asarray(is_known & (np.abs(tracks.speeds_mps) < limit_mps))

    def _covered(self, state: FrameState, tls: str) -> Covered:
        """Returns how much of each lane was covered by sensors whose scan or boxes arrived.

        Where there are LiDARs, a frame to which none contributed covers nothing. Where there are
        none, vehicles only report themselves, and coverage is undefined.
        """
        if not self._has_lidars:
            return Covered({}, {}, {})
        return self._coverage[tls].shares(state.sensors, self._config.coverage_range_m)
