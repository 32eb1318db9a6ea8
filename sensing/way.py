"""One agent's way to the edge: its radio and its queue, and the account of what it sends."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol

from protocol.bus import Bus
from protocol.messages import Objects, Plan, Scan, Span, Tick, Upload, WireCount
from sensing.radio import ENVELOPE_BYTES, Radio
from sensing.upload.outbox import Outbox
from sensing.upload.plans import Plans


class Terms(Protocol):
    """What all ways of a process share; `period_ns` is that of a frame."""

    @property
    def region(self) -> str:
        """Part of the city that the edge serves."""

    @property
    def process(self) -> str:
        """The process's id."""

    @property
    def lockstep(self) -> bool:
        """Whether the world waits for all that is sent."""

    @property
    def period_ns(self) -> int:
        """From one frame to the next."""


@dataclass(slots=True, eq=False)
class Shipment:
    """One frame of one agent on its way: what is to be sent, and what was."""

    tick: Tick
    uploads: list[Upload] = field(default_factory=list, kw_only=True)
    spans: list[Span] = field(default_factory=list, kw_only=True)

    @property
    def frame(self) -> int:
        """The frame's number."""
        return self.tick.frame

    @property
    def chunks(self) -> int:
        """How many chunks there are to be sent."""
        raise NotImplementedError

    def send(self, chunk: int) -> int:
        """See `sensing.upload.outbox.Shipment.send`."""
        raise NotImplementedError


class Way:
    """Belongs to one agent and has a connection of its own, so that its bytes can be told apart.

    In lockstep all chunks of a frame go out at once, and over a virtual link it shows when the next
    frame begins which of them left; in realtime an outbox sends them one by one.
    """

    def __init__(self, agent: str, bus: Bus, radio: Radio, terms: Terms) -> None:
        self.agent = agent
        self.bus = bus
        self.radio = radio
        self._terms = terms
        self._plans = Plans()
        self._frame = -1
        self._outbox = None if terms.lockstep else Outbox(agent)
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

    def ship(self, shipment: Shipment) -> None:
        """Sends a frame's chunks, or has the outbox do so."""
        if self._outbox is not None:
            self._outbox.put(shipment)
            return
        for chunk in range(shipment.chunks):
            shipment.send(chunk)
        self.keep(shipment)

    def keep(self, shipment: Shipment) -> None:
        """Keeps a frame that was sent at once, until it shows what became of it."""
        if self.radio.is_virtual:
            self._under_way = shipment
        else:
            self._done.append(shipment)

    def send(self, shipment: Shipment, message: Scan | Objects, begun_ns: int) -> int:
        """Sends a part of a shipment that was being made since then; returns its size in bytes.

        Over a virtual link, its arrival is added to the message.
        """
        part = _Part.of(message)
        size_bytes = part.payload_bytes + ENVELOPE_BYTES
        passage = self.radio.carry(shipment.tick.sim_time_ns, size_bytes, is_chunk=True)
        if passage is not None:
            message = message.model_copy(update={"arrival_sim_ns": passage.arrival_ns})
        terms, chunk = self._terms, {"chunk": str(part.chunk)} if isinstance(message, Scan) else {}
        where = {"region": terms.region, "process": terms.process, "agent": self.agent, **chunk}
        sent_bytes = self.bus.publish(part.topic, message, **where)
        sent_ns = time.monotonic_ns()
        shipment.spans += [
            self.span("encode", begun_ns, part.made_ns),
            self.span("send", part.made_ns, sent_ns),
        ]
        shipment.uploads.append(
            Upload(
                agent=self.agent,
                chunk=part.chunk,
                points=part.points,
                payload_bytes=part.payload_bytes,
                sense_start_ns=message.sense_start_ns,
                sense_end_ns=message.sense_end_ns,
                encode_end_ns=part.made_ns,
                sent_ns=sent_ns,
                link_sim_ns=passage and passage.took_ns,
            )
        )
        return sent_bytes

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
            self.begin(tick.frame + 1, tick.sim_time_ns + self._terms.period_ns)

    def span(self, stage: str, start_ns: int, end_ns: int) -> Span:
        """Returns a stage of this agent's work."""
        return Span(stage=stage, agent=self.agent, start_ns=start_ns, end_ns=end_ns)


@dataclass(frozen=True, slots=True)
class _Part:
    """What is booked of a message; it was made at `made_ns`."""

    topic: str
    chunk: int
    points: int
    payload_bytes: int
    made_ns: int

    @classmethod
    def of(cls, message: Scan | Objects) -> _Part:
        if isinstance(message, Scan):
            size_bytes, made_ns = message.payload.size, message.encode_end_ns
            return cls("scan", message.chunk, message.points, size_bytes, made_ns)
        size_bytes = message.boxes.nbytes + message.scores.nbytes
        return cls("objects", 0, len(message.boxes), size_bytes, message.detect_end_ns)
