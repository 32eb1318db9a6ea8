"""One agent's way to the edge: sense, select, encode, send, and account for it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from protocol.bus import Bus
from protocol.codec import encode_scan
from protocol.geometry import SE3
from protocol.messages import Message, Objects, Plan, Scan, Span, Tick, Upload, WireCount
from protocol.scans import RangeScan
from sensing.config import UploadConfig
from sensing.lidar import Sensed
from sensing.link.virtual import Passage
from sensing.noise import stream
from sensing.radio import ENVELOPE_BYTES, Radio
from sensing.source import ScanSource
from sensing.upload.objects import OnBoard
from sensing.upload.outbox import Outbox
from sensing.upload.plans import Plans
from sensing.upload.selection import Selection, Selector


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
class Shipment:
    """One frame of one agent on its way: what is to be sent, and what was."""

    uplink: Uplink
    tick: Tick
    scan: RangeScan
    selection: Selection
    believed_SE3_sensor: SE3
    sense_start_ns: int
    sense_end_ns: int
    uploads: list[Upload] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)

    @property
    def frame(self) -> int:
        """The frame's number."""
        return self.tick.frame

    @property
    def chunks(self) -> int:
        """How many chunks there are to be sent."""
        return self.selection.chunks

    def send(self, chunk: int) -> int:
        """See `sensing.upload.outbox.Shipment.send`."""
        return self.uplink.send_chunk(self, chunk)


class Uplink:
    """Belongs to one agent and has a connection of its own, so that its bytes can be told apart.

    In lockstep all chunks of a frame go out at once, and over a virtual link it shows when the next
    frame begins which of them left; in realtime an outbox sends them one by one.
    """

    def __init__(self, agent: str, bus: Bus, radio: Radio, kit: Kit, selector: Selector) -> None:
        self.agent = agent
        self.bus = bus
        self.radio = radio
        self._kit = kit
        self._selector = selector
        self._plans = Plans()
        self._frame = -1
        self._outbox = None if kit.lockstep else Outbox(agent)
        self._under_way: Shipment | None = None
        self._done: list[Shipment] = []
        self._recalled = 0
        self._counted_bytes = radio.wire_bytes()
        self._counted_frame: int | None = None

    @property
    def told(self) -> int:
        """The frame of which the edge said last that it has had enough; -1 before."""
        return -1 if self._plans.newest is None else self._plans.newest.enough

    @property
    def unsent_chunks(self) -> int:
        """Chunks that a newer frame has overtaken."""
        return self._recalled + (0 if self._outbox is None else self._outbox.unsent)

    def hear(self, plan: Plan) -> None:
        """Takes the edge's plan; an older one than the newest is left."""
        said_ns = plan.enough_sim_ns
        arrival_ns = 0 if said_ns is None else self.radio.hears_ns(said_ns)
        is_taken = self._plans.hear(plan, frame=self._frame, arrival_sim_ns=arrival_ns)
        if is_taken and self._outbox is not None:
            self._outbox.hear(enough=plan.enough, mbps=plan.mbps)

    def begin(self, frame: int, sim_time_ns: int) -> None:
        """Begins a frame: what of the last one has not begun to leave is not sent any more."""
        self._frame = frame
        last, self._under_way = self._under_way, None
        newest = self._plans.newest
        is_told = last is not None and newest is not None and newest.enough >= last.frame
        enough_sim_ns = newest.enough_sim_ns if newest is not None and is_told else None
        recalled = self.radio.begin(sim_time_ns, enough_sim_ns)
        self._recalled += 0 if is_told else recalled
        if last is not None:
            del last.uploads[len(last.uploads) - recalled :]
            self._done.append(last)

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
        shipment = Shipment(
            self, tick, sensed.scan, selection, believed_SE3_sensor, sense_start_ns, sense_end_ns
        )
        shipment.spans = [
            self._span("sense", sense_start_ns, sense_end_ns),
            self._span("select", sense_end_ns, time.monotonic_ns()),
        ]
        if self._kit.detector is not None:
            self._send_objects(shipment, self._kit.detector)
        elif self._outbox is not None:
            self._outbox.put(shipment)
            return sensed
        else:
            for chunk in range(shipment.chunks):
                shipment.send(chunk)
        if self.radio.is_virtual:
            self._under_way = shipment
        else:
            self._done.append(shipment)
        return sensed

    def take_done(self) -> list[Shipment]:
        """Returns the frames of which nothing more will be sent, once."""
        done, self._done = self._done, []
        if self._outbox is not None:
            done += [s for s in self._outbox.take_done() if isinstance(s, Shipment)]
        return done

    def settle(self, frame: int | None = None) -> list[WireCount]:
        """Returns what TCP sent for the last frame, if any; `frame` is the one that now begins."""
        before, self._counted_bytes = self._counted_bytes, self.radio.wire_bytes()
        last, self._counted_frame = self._counted_frame, frame
        sent_bytes = self._counted_bytes - before
        if last is None or sent_bytes <= 0:
            return []
        return [WireCount(agent=self.agent, frame=last, sent_bytes=sent_bytes)]

    def finish(self) -> None:
        """Sends nothing more; what leaves a virtual link within the last frame still does."""
        if self._outbox is not None:
            self._outbox.close()
        if self._under_way is not None:
            tick = self._under_way.tick
            self.begin(tick.frame + 1, tick.sim_time_ns + self._kit.period_ns)

    def send_chunk(self, shipment: Shipment, chunk: int) -> int:
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
        encode_end_ns = time.monotonic_ns()
        passage = self._carry(tick, len(payload))
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
            encode_end_ns=encode_end_ns,
            arrival_sim_ns=passage and passage.arrival_ns,
            payload=np.frombuffer(payload, np.uint8),
        )
        size_bytes = self._publish("scan", message, chunk=str(chunk))
        sent_ns = time.monotonic_ns()
        shipment.spans += [
            self._span("encode", start_ns, encode_end_ns),
            self._span("send", encode_end_ns, sent_ns),
        ]
        sizes = message.points, len(payload)
        upload = self._upload(shipment, chunk, sizes, (encode_end_ns, sent_ns), passage)
        shipment.uploads.append(upload)
        return size_bytes

    def _send_objects(self, shipment: Shipment, detector: OnBoard) -> None:
        """Sends boxes; finding them takes the place of encoding."""
        start_ns, tick = time.monotonic_ns(), shipment.tick
        rng = stream(self._kit.seed, "detect", self.agent, tick.frame)
        found = detector.detect(
            shipment.selection.part(shipment.scan, 0),
            shipment.believed_SE3_sensor,
            rng,
            ground_free=self._selector.is_ground_free,
        )
        detect_end_ns = time.monotonic_ns()
        boxes, scores = found.boxes.astype(np.float32), found.scores.astype(np.float32)
        passage = self._carry(tick, boxes.nbytes + scores.nbytes)
        message = Objects(
            frame=tick.frame,
            sim_time_ns=tick.sim_time_ns,
            agent=self.agent,
            boxes=boxes,
            scores=scores,
            sense_start_ns=shipment.sense_start_ns,
            sense_end_ns=shipment.sense_end_ns,
            detect_end_ns=detect_end_ns,
            arrival_sim_ns=passage and passage.arrival_ns,
        )
        self._publish("objects", message)
        sent_ns = time.monotonic_ns()
        shipment.spans += [
            self._span("encode", start_ns, detect_end_ns),
            self._span("send", detect_end_ns, sent_ns),
        ]
        sizes = len(found), boxes.nbytes + scores.nbytes
        upload = self._upload(shipment, 0, sizes, (detect_end_ns, sent_ns), passage)
        shipment.uploads.append(upload)

    def _publish(self, topic: str, message: Message, **parts: str) -> int:
        kit = self._kit
        where = {"region": kit.region, "process": kit.process, "agent": self.agent}
        return self.bus.publish(topic, message, **where, **parts)

    def _carry(self, tick: Tick, payload_bytes: int) -> Passage | None:
        return self.radio.carry(tick.sim_time_ns, payload_bytes + ENVELOPE_BYTES, is_chunk=True)

    def _upload(
        self,
        shipment: Shipment,
        chunk: int,
        sizes: tuple[int, int],
        stamps_ns: tuple[int, int],
        passage: Passage | None,
    ) -> Upload:
        """Describes a chunk by its points and bytes, and by when it was encoded and sent."""
        return Upload(
            agent=self.agent,
            chunk=chunk,
            points=sizes[0],
            payload_bytes=sizes[1],
            sense_start_ns=shipment.sense_start_ns,
            sense_end_ns=shipment.sense_end_ns,
            encode_end_ns=stamps_ns[0],
            sent_ns=stamps_ns[1],
            link_sim_ns=passage and passage.took_ns,
        )

    def _span(self, stage: str, start_ns: int, end_ns: int) -> Span:
        return Span(stage=stage, agent=self.agent, start_ns=start_ns, end_ns=end_ns)
