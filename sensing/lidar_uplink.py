"""The uplink of an agent with a LiDAR: sense, select, encode (or detect on board) and send."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.config import DetectionConfig, GeofenceConfig
from perception.detector import Cloud, Detector, Vehicles
from perception.registry import detector_of
from perception.roadway import Roadway
from protocol.bus import Bus
from protocol.codec import encode_scan
from protocol.geometry import SE3
from protocol.messages import Objects, Scan, Tick
from protocol.process import Context
from protocol.roadmap import RoadMap
from protocol.scans import RangeScan
from sensing.config import LidarConfig, SceneConfig, UploadConfig
from sensing.lidar import Sensed
from sensing.noise import stream
from sensing.radio import AgentKind, Radio
from sensing.source import ScanSource, source_of
from sensing.terrain import Terrain
from sensing.uplink import FrameUpload, Uplink, UplinkContext
from sensing.upload_policies import policy_of
from sensing.upload_selection import Selection, Selector, chooser_of


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
        return self.detector.detect(Cloud(near, bare, map_SE3_sensor.translation[None]), rng)


@dataclass(frozen=True, slots=True)
class LidarContext(UplinkContext):
    """What all uplinks of a process with LiDARs share; a detector only if agents send objects."""

    seed: int
    source: ScanSource
    config: UploadConfig
    detector: OnboardDetector | None


@dataclass(slots=True, eq=False)
class _ScanUpload(FrameUpload):
    """The upload of a scan: chunks are encoded as they are sent."""

    uplink: LidarUplink
    scan: RangeScan
    selection: Selection
    estimated_SE3_sensor: SE3
    sense_start_ns: int
    sense_end_ns: int

    @property
    def chunks(self) -> int:
        """See `FrameUpload.chunks`."""
        return self.selection.chunks

    def send(self, chunk: int) -> int:
        """See `FrameUpload.send`."""
        return self.uplink.send_chunk(self, chunk)


class LidarUplink(Uplink):
    """The uplink of an agent that has a LiDAR."""

    def __init__(
        self, agent: str, bus: Bus, radio: Radio, context: LidarContext, selector: Selector
    ) -> None:
        super().__init__(agent, bus, radio, context)
        self._shared = context
        self._selector = selector

    def sense_and_send(
        self,
        tick: Tick,
        map_SE3_sensor: SE3,
        estimated_SE3_sensor: SE3,
        own: int | None,
    ) -> Sensed:
        """Scans once from the true pose and sends the scan, or its part, with the estimated one."""
        sense_start_ns = time.monotonic_ns()
        sensed = self._shared.source.scan(self.agent, tick, map_SE3_sensor, own)
        sense_end_ns = time.monotonic_ns()
        plan = self._plans.of(tick.frame, tick.sim_time_ns)
        selection = self._selector.select(sensed.scan, estimated_SE3_sensor, self.agent, plan)
        upload = _ScanUpload(
            tick, self, sensed.scan, selection, estimated_SE3_sensor, sense_start_ns, sense_end_ns
        )
        upload.spans = [
            self.span("sense", sense_start_ns, sense_end_ns),
            self.span("select", sense_end_ns, time.monotonic_ns()),
        ]
        if self._shared.detector is not None:
            self._send_objects(upload, self._shared.detector)
            self.keep(upload)
        else:
            self.submit(upload)
        return sensed

    def send_chunk(self, upload: _ScanUpload, chunk: int) -> int:
        """Encodes and sends a chunk; returns the size of the message in bytes."""
        start_ns = time.monotonic_ns()
        part = upload.selection.part(upload.scan, chunk)
        config, tick = self._shared.config, upload.tick
        payload = encode_scan(
            part,
            config.max_error_m,
            profile=config.profile,
            intensity=config.intensity,
        )
        message = Scan(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=self.agent,
            chunk=chunk,
            chunks=upload.chunks,
            points=int(np.count_nonzero(part.range_m)),
            plan_frame=upload.selection.plan_frame,
            ground_free=self._selector.is_ground_free,
            sensor_pose=upload.estimated_SE3_sensor.as_pose(),
            sense_start_ns=upload.sense_start_ns,
            sense_end_ns=upload.sense_end_ns,
            encode_end_ns=time.monotonic_ns(),
            payload=np.frombuffer(payload, np.uint8),
        )
        return self.send(upload, message, start_ns)

    def _send_objects(self, upload: _ScanUpload, detector: OnboardDetector) -> None:
        """Sends detected boxes; detection replaces encoding."""
        start_ns, tick = time.monotonic_ns(), upload.tick
        rng = stream(self._shared.seed, "detect", self.agent, tick.frame)
        found = detector.detect(
            upload.selection.part(upload.scan, 0),
            upload.estimated_SE3_sensor,
            rng,
            ground_free=self._selector.is_ground_free,
        )
        message = Objects(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=self.agent,
            boxes=found.boxes.astype(np.float32),
            scores=found.scores.astype(np.float32),
            sense_start_ns=upload.sense_start_ns,
            sense_end_ns=upload.sense_end_ns,
            detect_end_ns=time.monotonic_ns(),
        )
        self.send(upload, message, start_ns)


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
        self._roadway = Roadway.of(road_map, margin_m=upload.roi_margin_m)
        detects = self._policy.sends == "objects"
        self._shared = LidarContext(
            region=scenario["region"],
            process=context.id,
            seed=scenario["seed"],
            source=source_of(context.setup, config),
            config=upload,
            detector=OnboardDetector.of(road_map, scenario["edge"]) if detects else None,
            lockstep=scenario["mode"] == "lockstep",
            period_ns=round(scenario["frame_period_s"] * 1e9),
        )

    def uplink(self, agent: str, bus: Bus, radio: Radio) -> LidarUplink:
        """Returns the uplink of an agent with this connection."""
        selector = Selector(
            self._policy,
            self._chosen.filters,
            self._roadway,
            self._pattern,
            chooser_of(self._chosen.policy, self._shared.config, self._roadway, self._pattern),
            thin_m=self._shared.config.thin_m,
            stationary=self._stationary,
        )
        return LidarUplink(agent, bus, radio, self._shared, selector)

    def close(self) -> None:
        """Closes the scan source, after all uplinks are closed."""
        self._shared.source.close()
