"""One agent's way to the edge: sense, encode, send, and account for it."""

from __future__ import annotations

import time

import numpy as np

from protocol.bus import Bus
from protocol.codec import encode_scan
from protocol.geometry import SE3
from protocol.messages import Scan, Span, Tick, Upload
from sensing.config import UploadConfig
from sensing.lidar import Lidar
from sensing.noise import stream
from sensing.radio import ENVELOPE_BYTES, Radio


class Uplink:
    """Belongs to one agent and has a connection of its own, so that its bytes can be told apart."""

    def __init__(
        self,
        agent: str,
        region: str,
        bus: Bus,
        radio: Radio,
        lidar: Lidar,
        config: UploadConfig,
        seed: int,
    ) -> None:
        self.agent = agent
        self.bus = bus
        self.radio = radio
        self._region = region
        self._lidar = lidar
        self._config = config
        self._seed = seed
        self._wire_bytes = bus.wire_bytes()

    def sense_and_send(
        self,
        tick: Tick,
        map_SE3_sensor: SE3,
        believed_SE3_sensor: SE3,
        own: int | None,
    ) -> tuple[Upload, list[Span]]:
        """Casts one scan from the true pose and sends it with the believed one."""
        sense_start_ns = time.monotonic_ns()
        rng = stream(self._seed, "scan", self.agent, tick.frame)
        scan = self._lidar.scan(map_SE3_sensor, tick.poses, tick.types, own, rng)
        sense_end_ns = time.monotonic_ns()
        payload = encode_scan(scan, self._config.max_error_m, intensity=self._config.intensity)
        encode_end_ns = time.monotonic_ns()
        passage = self.radio.carry(tick.sim_time_ns, len(payload) + ENVELOPE_BYTES)
        message = Scan(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=self.agent,
            chunk=0,
            chunks=1,
            points=int(np.count_nonzero(scan.range_m)),
            sensor_pose=believed_SE3_sensor.as_pose(),
            sense_start_ns=sense_start_ns,
            sense_end_ns=sense_end_ns,
            encode_end_ns=encode_end_ns,
            arrival_sim_ns=passage and passage.arrival_ns,
            payload=np.frombuffer(payload, np.uint8),
        )
        self.bus.publish("scan", message, region=self._region, agent=self.agent, chunk="0")
        sent_ns = time.monotonic_ns()
        upload = Upload(
            agent=self.agent,
            chunk=0,
            points=message.points,
            payload_bytes=len(payload),
            wire_bytes=self._count_wire(),
            sense_start_ns=sense_start_ns,
            sense_end_ns=sense_end_ns,
            encode_end_ns=encode_end_ns,
            sent_ns=sent_ns,
            link_sim_ns=passage and passage.took_ns,
        )
        stamps = (sense_start_ns, sense_end_ns, encode_end_ns, sent_ns)
        stages = zip(("sense", "encode", "send"), stamps, stamps[1:], strict=False)
        return upload, [
            Span(stage=name, agent=self.agent, start_ns=start, end_ns=end)
            for name, start, end in stages
        ]

    def _count_wire(self) -> int:
        before, self._wire_bytes = self._wire_bytes, self.bus.wire_bytes()
        return max(0, self._wire_bytes - before)
