"""What one agent senses on its way to the edge: sense, select, encode."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from protocol.bus import Bus
from protocol.codec import encode_scan
from protocol.geometry import SE3
from protocol.messages import Objects, Scan, Tick
from protocol.scans import RangeScan
from sensing.config import UploadConfig
from sensing.lidar import Sensed
from sensing.noise import stream
from sensing.radio import Radio
from sensing.source import ScanSource
from sensing.upload.objects import OnBoard
from sensing.upload.selection import Selection, Selector
from sensing.way import Shipment, Way


@dataclass(frozen=True, slots=True)
class Kit:
    """What all uplinks of a process share."""

    region: str
    process: str
    seed: int
    source: ScanSource
    config: UploadConfig
    detector: OnBoard | None  # of agents that send objects
    lockstep: bool
    period_ns: int  # of a frame


@dataclass(slots=True, eq=False)
class _Sensed(Shipment):
    """A frame that was sensed: chunks are encoded as they are sent."""

    uplink: Uplink
    scan: RangeScan
    selection: Selection
    believed_SE3_sensor: SE3
    sense_start_ns: int
    sense_end_ns: int

    @property
    def chunks(self) -> int:
        """See `Shipment.chunks`."""
        return self.selection.chunks

    def send(self, chunk: int) -> int:
        """See `Shipment.send`."""
        return self.uplink.send_chunk(self, chunk)


class Uplink(Way):
    """The way of an agent that has a sensor."""

    def __init__(self, agent: str, bus: Bus, radio: Radio, kit: Kit, selector: Selector) -> None:
        super().__init__(agent, bus, radio, kit)
        self._kit = kit
        self._selector = selector

    def sense_and_send(
        self,
        tick: Tick,
        map_SE3_sensor: SE3,
        believed_SE3_sensor: SE3,
        own: int | None,
    ) -> Sensed:
        """Senses once from the true pose and sends it, or its part, with the believed one."""
        sense_start_ns = time.monotonic_ns()
        sensed = self._kit.source.scan(self.agent, tick, map_SE3_sensor, own)
        sense_end_ns = time.monotonic_ns()
        plan = self._plans.of(tick.frame, tick.sim_time_ns)
        selection = self._selector.select(sensed.scan, believed_SE3_sensor, self.agent, plan)
        shipment = _Sensed(
            tick, self, sensed.scan, selection, believed_SE3_sensor, sense_start_ns, sense_end_ns
        )
        shipment.spans = [
            self.span("sense", sense_start_ns, sense_end_ns),
            self.span("select", sense_end_ns, time.monotonic_ns()),
        ]
        if self._kit.detector is not None:
            self._send_objects(shipment, self._kit.detector)
            self.keep(shipment)
        else:
            self.ship(shipment)
        return sensed

    def send_chunk(self, shipment: _Sensed, chunk: int) -> int:
        """Encodes a chunk and sends it; returns the message's size in bytes."""
        start_ns = time.monotonic_ns()
        part = shipment.selection.part(shipment.scan, chunk)
        config, tick = self._kit.config, shipment.tick
        payload = encode_scan(
            part,
            config.max_error_m,
            profile=config.profile,
            intensity=config.intensity,
            fill=config.fill_lost and part is shipment.scan,
        )
        message = Scan(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=self.agent,
            chunk=chunk,
            chunks=shipment.chunks,
            points=int(np.count_nonzero(part.range_m)),
            plan_frame=shipment.selection.plan_frame,
            ground_free=self._selector.is_ground_free,
            sensor_pose=shipment.believed_SE3_sensor.as_pose(),
            sense_start_ns=shipment.sense_start_ns,
            sense_end_ns=shipment.sense_end_ns,
            encode_end_ns=time.monotonic_ns(),
            payload=np.frombuffer(payload, np.uint8),
        )
        return self.send(shipment, message, start_ns)

    def _send_objects(self, shipment: _Sensed, detector: OnBoard) -> None:
        """Sends boxes; finding them takes the place of encoding."""
        start_ns, tick = time.monotonic_ns(), shipment.tick
        rng = stream(self._kit.seed, "detect", self.agent, tick.frame)
        found = detector.detect(
            shipment.selection.part(shipment.scan, 0),
            shipment.believed_SE3_sensor,
            rng,
            ground_free=self._selector.is_ground_free,
        )
        message = Objects(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=self.agent,
            boxes=found.boxes.astype(np.float32),
            scores=found.scores.astype(np.float32),
            sense_start_ns=shipment.sense_start_ns,
            sense_end_ns=shipment.sense_end_ns,
            detect_end_ns=time.monotonic_ns(),
        )
        self.send(shipment, message, start_ns)
