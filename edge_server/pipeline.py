"""From scans and poses to counts per lane, as in Chen et al. 2022. Knows no network."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.frame import Chunk, Frame, decode_chunk
from edge_server.fusion import fuse
from edge_server.lanes import CoverageShares, LaneCoverage, LaneIndex, LanePositions
from edge_server.merge import sensor_in_map
from edge_server.misbehaviour import Judged, Plausibility
from edge_server.spans import Spans
from edge_server.stationary import StationaryVehicles
from perception.arrays import Floats
from perception.detector import Cloud, DetectorMaker, Vehicles
from perception.registry import detector_of
from perception.roadway import Placed, Roadway
from protocol.messages import Detections, Doubt, LaneCounts, Scan, Span
from protocol.roadmap import RoadMap


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a frame gave: messages to publish, the time of each stage, the points merged.

    `left_out` counts by reason the agents that were not believed.
    """

    detections: Detections
    counts: LaneCounts
    spans: list[Span]
    points: int
    left_out: Counter[str] = field(default_factory=Counter)
    doubts: list[Doubt] = field(default_factory=list)


class Pipeline:
    """The stages and what they know about the road.

    No frame depends on another, except for which of its vehicles stand still and which of its
    agents are believed. `posts` are x, y and yaw (3,) of the mounts that are known.
    """

    def __init__(
        self,
        road_map: RoadMap,
        config: EdgeConfig,
        *,
        seed: int,
        detector: DetectorMaker = detector_of,
        has_lidars: bool = True,
        posts: Mapping[str, Floats] | None = None,
    ) -> None:
        """Prepares for a road; `has_lidars` says whether agents send what they see at all."""
        self._map = road_map
        self._has_lidars = has_lidars
        self._config = config
        self._seed = [seed, zlib.crc32(b"ground")]
        self._roadway = Roadway.of(road_map, margin_m=config.geofence.margin_m)
        self._detector = detector(config, self._roadway)
        self._lanes = LaneIndex(road_map)
        self._sight = LaneCoverage(
            road_map, self._lanes, upstream_m=config.upstream_m, downstream_m=config.downstream_m
        )
        self._standing = StationaryVehicles(config.standing_mps)
        self._centre = np.array(road_map.centre)
        self._posts = posts or {}
        self._plausibility = (
            Plausibility(road_map, self._roadway, config.plausibility, self._posts)
            if config.plausibility.enabled
            else None
        )

    def run(self, frame: Frame) -> Result:
        """Finds and counts the vehicles of one frame."""
        config, spans = self._config, Spans()
        rng = np.random.default_rng([*self._seed, frame.frame])
        with spans.stage("merge"):
            judged = self._judged(frame)
            frame = judged.frame
            near, bare = (
                [p.placed for p in frame.chunks if p.placed and p.ground_free is is_bare]
                for is_bare in (False, True)
            )
        found = self._detector.detect(Cloud(near, bare, _sensors(frame.chunks)), rng, spans.stage)
        with spans.stage("fuse"):
            for objects in (one.objects for one in frame.found):
                found += Vehicles.from_lidar(
                    objects.boxes.astype(np.float64), objects.scores.astype(np.float64)
                )
            vehicles = fuse(found, frame.poses, centre=self._centre, config=config.fusion)
            place = self._lanes.locate(
                vehicles.boxes, margin_m=config.geofence.margin_m + vehicles.position_std_m
            )
            on_road = place.lane >= 0
            vehicles, place = vehicles.take(on_road), place.take(on_road)
        with spans.stage("count"):
            detections = self._detections(frame, vehicles, place)
            still = self._standing.mark(frame.sim_time_ns, vehicles.boxes[:, :2])
            counts = self._counts(frame, place, place.take(still))
        points = sum(chunk.returns for chunk in frame.chunks)
        return Result(detections, counts, spans.done, points, judged.left_out, judged.doubts)

    def open(self, scan: Scan, received_ns: int) -> Chunk:
        """Decodes a chunk and places it, if that needs nothing of others; for any thread.

        Raises:
            CodecError: the payload is not a scan.
        """
        return self.place_early(decode_chunk(scan, received_ns))

    def place_early(self, chunk: Chunk) -> Chunk:
        """Places a piece while others are still under way, if that needs nothing of theirs."""
        if self._config.merge != "se3":
            return chunk
        placed, checks = self.place(chunk, chunk.sensor_pose), self._plausibility
        view = None if checks is None else checks.view([placed], chunk.sensor_pose)
        return chunk.with_placed(placed, view)

    def place(self, chunk: Chunk, reference_pose: Floats) -> Placed:
        """Moves a piece's points into the map and leaves out what is off the road."""
        if chunk.placed is not None:
            return chunk.placed
        map_SE3_sensor = sensor_in_map(
            chunk.sensor_pose, method=self._config.merge, reference_pose=reference_pose
        )
        fence = self._config.geofence
        return self._roadway.place(
            chunk.points, map_SE3_sensor, below_m=fence.below_m, above_m=fence.above_m
        )

    def _judged(self, frame: Frame) -> Judged:
        """Returns the frame with its pieces placed, without the agents that are not believed."""
        reference = _reference(frame)
        chunks = [replace(chunk, placed=self.place(chunk, reference)) for chunk in frame.chunks]
        frame = replace(frame, chunks=chunks)
        if self._plausibility is None:
            return Judged(frame, Counter(), [])
        return self._plausibility.judge(frame)

    def _detections(self, frame: Frame, vehicles: Vehicles, place: LanePositions) -> Detections:
        return Detections(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            agents=frame.agents,
            boxes=vehicles.boxes.astype(np.float32),
            scores=vehicles.scores.astype(np.float32),
            lanes=self._lanes.names(place),
            distances_m=self._lanes.distances_m(place).astype(np.float32),
            sources=vehicles.sources,
        )

    def _counts(self, frame: Frame, place: LanePositions, queued: LanePositions) -> LaneCounts:
        reach = self._config.upstream_m, self._config.downstream_m
        (upstream, downstream), (queued_upstream, queued_downstream) = (
            self._lanes.count(part, upstream_m=reach[0], downstream_m=reach[1])
            for part in (place, queued)
        )
        seen_upstream, seen_downstream = self._seen(frame)
        return LaneCounts(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            tls=self._map.signal.tls,
            agents=frame.agents,
            complete=frame.complete,
            upstream=upstream,
            downstream=downstream,
            queued_upstream=queued_upstream,
            queued_downstream=queued_downstream,
            seen_upstream=seen_upstream,
            seen_downstream=seen_downstream,
            delay_sim_ns=frame.delay_sim_ns,
        )

    def _seen(self, frame: Frame) -> tuple[CoverageShares, CoverageShares]:
        """Returns what of each lane was within sight of those whose scan or boxes came.

        Where there are LiDARs, a frame to which none contributed is one that nobody sees. Where
        there are none, vehicles report themselves alone: then sight means nothing.
        """
        if not self._has_lidars:
            return {}, {}
        seeing = [chunk for chunk in frame.chunks if not chunk.is_undecodable]
        places_m = np.concatenate([_sensors(seeing)[:, :2], self._finders(frame)])
        return self._sight.shares(places_m, self._config.sight_m)

    def _finders(self, frame: Frame) -> Floats:
        """Returns where those (N, 2) stand who sent boxes, as far as that is known."""
        places = {name: place[:2] for name, place in self._posts.items()}
        places |= {pose.agent: pose.pose[:2] for pose in frame.poses}
        known = [places[one.agent] for one in frame.found if one.agent in places]
        return np.array(known).reshape(-1, 2)


def _sensors(chunks: Sequence[Chunk]) -> Floats:
    return np.array([chunk.sensor_pose[:3] for chunk in chunks]).reshape(-1, 3)


def _reference(frame: Frame) -> Floats:
    """Returns the pose of the paper's reference LiDAR: a roadside one, else the first."""
    if not frame.chunks:
        return np.zeros(6)
    driving = {pose.agent for pose in frame.poses}
    standing = [chunk for chunk in frame.chunks if chunk.agent not in driving]
    return (standing or frame.chunks)[0].sensor_pose
