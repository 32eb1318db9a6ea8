"""Uplink of an agent with a LiDAR: scan, select, encode (or detect on board) and send."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perception.config import DetectionConfig, GeofenceConfig
from perception.detector import Cloud, Detector, Vehicles
from perception.map_height import on_the_ground
from perception.registry import detector_of
from perception.roadway import Roadway
from protocol.bus import Bus
from protocol.codec import encode_scan
from protocol.geometry import SE3
from protocol.messages import Objects, Scan
from protocol.process import Context
from protocol.regions import regions_of
from protocol.roadmap import RoadMap
from protocol.scans import RangeScan
from sensing.config import LidarConfig, SceneConfig, UploadConfig
from sensing.lidar import Sensed
from sensing.noise import stream
from sensing.radio import AgentKind, Radio
from sensing.source import ScanSource, source_of
from sensing.terrain import Terrain, believed_map
from sensing.uplink import FrameUpload, Uplink, UplinkContext
from sensing.upload_policies import Filter, policy_of
from sensing.upload_selection import Selection, Selector, chooser_of
from sensing.world_view import WorldView


@dataclass(frozen=True, slots=True, eq=False)
class OnboardDetector:
    """Detection on the agent: the edge's detector and parameters, on one agent's scan."""

    roadway: Roadway
    geofence: GeofenceConfig
    detector: Detector

    @classmethod
    def of(cls, road_map: RoadMap, edge: dict[str, Any]) -> OnboardDetector:
        """Builds the detector from the scenario's section of the edge."""
        chosen = {name: edge[name] for name in DetectionConfig.model_fields}
        config = DetectionConfig.model_validate(chosen)
        roadway = Roadway.of(road_map, margin_m=config.geofence.margin_m)
        return cls(roadway, config.geofence, detector_of(config, roadway))

    def detect(
        self, scan: RangeScan, map_SE3_sensor: SE3, rng: np.random.Generator, *, ground_free: bool
    ) -> Vehicles:
        """Returns the vehicles in a scan, in the map frame; `ground_free` scans have no ground."""
        placed = self.roadway.place(
            scan.cloud().points,
            map_SE3_sensor,
            below_m=self.geofence.below_m,
            above_m=self.geofence.above_m,
        )
        near, bare = ([], [placed]) if ground_free else ([placed], [])
        cloud = on_the_ground(Cloud(near, bare, map_SE3_sensor.translation[None]))
        return self.detector.detect(cloud, rng)


@dataclass(frozen=True, slots=True)
class LidarContext(UplinkContext):
    """What all uplinks of a process with LiDARs share; detectors only if agents send objects."""

    seed: int
    source: ScanSource
    config: UploadConfig
    detector_of: Callable[[str], OnboardDetector] | None


@dataclass(slots=True, eq=False)
class _ScanUpload(FrameUpload):
    """The upload of a scan: chunks are encoded as they are sent."""

    uplink: LidarUplink
    scan: RangeScan
    parts: Mapping[str, Selection]
    estimated_SE3_sensor: SE3
    sense_start_ns: int
    sense_end_ns: int
    order: list[tuple[int, str]] = field(init=False)

    def __post_init__(self) -> None:
        """Orders the chunks: first the first of each region, then the second of each."""
        parts = self.parts.items()
        self.order = sorted((n, region) for region, part in parts for n in range(part.chunks))

    @property
    def chunks(self) -> int:
        """See `FrameUpload.chunks`."""
        return len(self.order)

    def send(self, chunk: int) -> int:
        """See `FrameUpload.send`."""
        number, region = self.order[chunk]
        return self.uplink.send_chunk(self, region, number)


class LidarUplink(Uplink):
    """The uplink of an agent that has a LiDAR."""

    def __init__(
        self,
        agent: str,
        bus: Bus,
        radio: Radio,
        context: LidarContext,
        selector_of: Callable[[str], Selector],
    ) -> None:
        super().__init__(agent, bus, radio, context)
        self._shared = context
        self._selector_of = selector_of
        self._selectors: dict[str, Selector] = {}

    def enter(self, regions: Iterable[str]) -> None:
        """See `Uplink.enter`; each region gets the part of the scan that covers its roads."""
        super().enter(regions)
        known = self._selectors
        self._selectors = {name: known.get(name) or self._selector_of(name) for name in self._plans}

    def sense_and_send(
        self,
        view: WorldView,
        map_SE3_sensor: SE3,
        estimated_SE3_sensor: SE3,
        own: int | None,
    ) -> Sensed:
        """Scans once from the true pose and sends the scan, or its part, with the estimated one."""
        sense_start_ns = time.monotonic_ns()
        sensed = self._shared.source.scan(self.agent, view, map_SE3_sensor, own)
        sense_end_ns = time.monotonic_ns()
        parts = {
            region: selector.select(
                sensed.scan,
                estimated_SE3_sensor,
                self.agent,
                self._plans[region].of(view.frame, view.sim_time_ns),
            )
            for region, selector in self._selectors.items()
        }
        upload = _ScanUpload(
            view, self, sensed.scan, parts, estimated_SE3_sensor, sense_start_ns, sense_end_ns
        )
        upload.spans = [
            self.span("sense", sense_start_ns, sense_end_ns),
            self.span("select", sense_end_ns, time.monotonic_ns()),
        ]
        if self._shared.detector_of is not None:
            for region in upload.parts:
                self._send_objects(upload, region, self._shared.detector_of(region))
            self.keep(upload)
        else:
            self.submit(upload)
        return sensed

    def send_chunk(self, upload: _ScanUpload, region: str, chunk: int) -> int:
        """Encodes and sends a region's chunk; returns the size of the message in bytes."""
        start_ns = time.monotonic_ns()
        selection = upload.parts[region]
        part = selection.part(upload.scan, chunk)
        config, view = self._shared.config, upload.view
        payload = encode_scan(
            part,
            config.max_error_m,
            profile=config.profile,
            intensity=config.intensity,
        )
        message = Scan(
            frame=view.frame,
            sim_time_ns=view.sim_time_ns,
            agent=self.agent,
            chunk=chunk,
            chunks=selection.chunks,
            points=int(np.count_nonzero(part.range_m)),
            plan_frame=selection.plan_frame,
            ground_free=self._selectors[region].is_ground_free,
            sensor_pose=upload.estimated_SE3_sensor.as_pose(),
            sense_start_ns=upload.sense_start_ns,
            sense_end_ns=upload.sense_end_ns,
            encode_end_ns=time.monotonic_ns(),
            payload=np.frombuffer(payload, np.uint8),
        )
        return self.send(upload, message, region, start_ns)

    def _send_objects(self, upload: _ScanUpload, region: str, detector: OnboardDetector) -> None:
        """Sends a region the boxes that are detected in its part; this replaces encoding."""
        start_ns, view = time.monotonic_ns(), upload.view
        rng = stream(self._shared.seed, "detect", self.agent, view.frame)
        found = detector.detect(
            upload.parts[region].part(upload.scan, 0),
            upload.estimated_SE3_sensor,
            rng,
            ground_free=self._selectors[region].is_ground_free,
        )
        message = Objects(
            frame=view.frame,
            sim_time_ns=view.sim_time_ns,
            agent=self.agent,
            boxes=found.boxes.astype(np.float32),
            scores=found.scores.astype(np.float32),
            classes=found.classes,
            sense_start_ns=upload.sense_start_ns,
            sense_end_ns=upload.sense_end_ns,
            detect_end_ns=time.monotonic_ns(),
        )
        self.send(upload, message, region, start_ns)


_ROI: frozenset[Filter] = frozenset({"roi"})


class LidarUplinks:
    """Makes the uplinks of a process's agents of one kind, and what these share."""

    def __init__(self, context: Context, kind: AgentKind) -> None:
        scenario, road_map = context.setup.scenario, context.setup.road_map
        config = LidarConfig.model_validate(scenario["lidar"][kind])
        scene = SceneConfig.model_validate(scenario["scene"])
        upload = UploadConfig.model_validate(scenario["upload"])
        self.terrain = Terrain(road_map, scene, scenario["seed"])
        self._pattern = config.pattern
        self._stationary = kind == "roadside"
        self._chosen = upload.of(kind)
        self._policy = policy_of(self._chosen.policy)
        self._edge = scenario["edge"]
        self._upload = upload
        self.regions = regions_of(believed_map(road_map, scene, scenario["seed"]), scenario)
        self._roadways: dict[str, Roadway] = {}
        self._detectors: dict[str, OnboardDetector] = {}
        detects = self._policy.sends == "objects"
        self._shared = LidarContext(
            process=context.id,
            seed=scenario["seed"],
            source=source_of(context.setup, config),
            config=upload,
            detector_of=self._detector if detects else None,
            lockstep=scenario["mode"] == "lockstep",
            period_ns=round(scenario["frame_period_s"] * 1e9),
        )

    def uplink(self, agent: str, bus: Bus, radio: Radio) -> LidarUplink:
        """Returns the uplink of an agent with this connection."""
        return LidarUplink(agent, bus, radio, self._shared, self._selector)

    def _selector(self, region: str) -> Selector:
        """Returns a selector for a region; of several, each gets what covers its roads alone."""
        if region not in self._roadways:
            area, margin_m = self.regions[region].area, self._upload.roi_margin_m
            self._roadways[region] = Roadway.of(area, margin_m=margin_m)
        roadway, cut = self._roadways[region], _ROI if len(self.regions) > 1 else frozenset()
        return Selector(
            self._policy,
            self._chosen.filters | cut,
            roadway,
            self._pattern,
            chooser_of(self._chosen.policy, self._upload, roadway, self._pattern),
            thin_m=self._upload.thin_m,
            stationary=self._stationary,
        )

    def _detector(self, region: str) -> OnboardDetector:
        if region not in self._detectors:
            self._detectors[region] = OnboardDetector.of(self.regions[region].area, self._edge)
        return self._detectors[region]

    def close(self) -> None:
        """Closes the scan source, after all uplinks are closed."""
        self._shared.source.close()
