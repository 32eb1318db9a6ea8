"""An agent's uplink to the edge: the plans it follows, its send queue, what it sent."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Protocol

from protocol.bus import Bus
from protocol.errors import CpnetError
from protocol.messages import Objects, Plan, Scan, Span, Tick, Upload, WireCount
from sensing.radio import ENVELOPE_BYTES, Radio

MAX_AGE_FRAMES = 10  # an older plan is of a scene that has passed
MAX_AHEAD_FRAMES = 64  # a plan for later than this is an error


@dataclass(frozen=True, slots=True, eq=False)
class _ReceivedPlan:
    """A plan, and when it arrived over a virtual link; 0 where links are real."""

    plan: Plan
    arrival_sim_ns: int


class Plans:
    """Keeps the plans of the last frames. A plan holds from its frame on."""

    def __init__(self) -> None:
        self._received: list[_ReceivedPlan] = []

    @property
    def newest(self) -> Plan | None:
        """The newest plan, be its frame still to come."""
        return self._received[-1].plan if self._received else None

    def receive(self, plan: Plan, *, frame: int, arrival_sim_ns: int) -> bool:
        """Takes a plan while a frame is played; one that is older, or absurd, is left."""
        newest = self.newest
        is_news = newest is None or plan.frame > newest.frame
        if not is_news or plan.frame > frame + MAX_AHEAD_FRAMES:
            return False
        self._received = [h for h in self._received if h.plan.frame >= frame - MAX_AGE_FRAMES]
        self._received.append(_ReceivedPlan(plan, arrival_sim_ns))
        return True

    def of(self, frame: int, sim_time_ns: int) -> Plan | None:
        """Returns the plan to follow in a frame that begins then."""
        for heard in reversed(self._received):
            age_frames = frame - heard.plan.frame
            if 0 <= age_frames <= MAX_AGE_FRAMES and heard.arrival_sim_ns <= sim_time_ns:
                return heard.plan
        return None


EARLY_NS = 4_000_000  # a chunk may queue so long, lest the uplink runs dry
LONGEST_NS = 1_000_000_000  # a rate that was wrong is tried again after this


class _Shipment(Protocol):
    """A frame's chunks."""

    @property
    def frame(self) -> int:
        """The frame's number."""

    @property
    def chunks(self) -> int:
        """How many chunks there are to be sent."""

    def send(self, chunk: int) -> int:
        """Sends a chunk; returns its size in bytes."""


class Outbox:
    """Belongs to one agent. `unsent` counts the chunks that a newer frame made useless."""

    def __init__(self, agent: str) -> None:
        self._turn = threading.Condition()
        self._next: _Shipment | None = None
        self._enough = -1
        self._mbps = 0.0
        self._free_ns = 0
        self._closed = False
        self._error: CpnetError | None = None
        self._done: list[_Shipment] = []
        self.unsent = 0
        self._thread = threading.Thread(target=self._run, name=f"outbox {agent}", daemon=True)
        self._thread.start()

    def put(self, shipment: _Shipment) -> None:
        """Takes the newest frame, in the place of what was not sent of the frame before.

        Raises:
            CpnetError: what the last frame failed with.
        """
        with self._turn:
            if self._error is not None:
                raise self._error
            if self._next is not None:
                self.unsent += self._next.chunks
            self._next = shipment
            self._turn.notify()

    def receive(self, *, enough: int, mbps: float) -> None:
        """Takes note of which frames need no more chunks, and of the rate, 0 if it is unknown."""
        with self._turn:
            self._enough, self._mbps = max(enough, self._enough), mbps
            self._turn.notify()

    def take_done(self) -> list[_Shipment]:
        """Returns the frames of which nothing more will be sent, once."""
        with self._turn:
            done, self._done = self._done, []
        return done

    def close(self) -> None:
        """Sends nothing more; waits a second for a chunk that is on its way."""
        with self._turn:
            self._closed = True
            self._turn.notify()
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            while (shipment := self._take()) is not None:
                self._ship(shipment)
                with self._turn:
                    self._done.append(shipment)
        except CpnetError as error:
            with self._turn:
                self._error = error

    def _take(self) -> _Shipment | None:
        with self._turn:
            self._turn.wait_for(lambda: self._closed or self._next is not None)
            shipment, self._next = self._next, None
            return None if self._closed else shipment

    def _ship(self, shipment: _Shipment) -> None:
        for chunk in range(shipment.chunks):
            if not self._wait_for_turn(shipment.frame):
                with self._turn:
                    left_behind = self._next is not None and self._enough < shipment.frame
                    self.unsent += (shipment.chunks - chunk) * left_behind
                return
            size_bytes = shipment.send(chunk)
            with self._turn:
                latency_ns = round(size_bytes * 8e3 / self._mbps) if self._mbps else 0
                begun_ns = max(self._free_ns, time.monotonic_ns())
                self._free_ns = begun_ns + min(latency_ns, LONGEST_NS)

    def _wait_for_turn(self, frame: int) -> bool:
        """Waits until the uplink takes a chunk of a frame; False if it is no longer wanted."""
        with self._turn:
            while not (self._closed or self._next is not None or self._enough >= frame):
                wait_ns = self._free_ns - EARLY_NS - time.monotonic_ns()
                if wait_ns <= 0:
                    return True
                self._turn.wait(wait_ns / 1e9)
        return False


class UplinkContext(Protocol):
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
class FrameUpload:
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
        """See `sensing.uplink._Shipment.send`."""
        raise NotImplementedError


class Uplink:
    """Belongs to one agent and has a connection of its own, so that its bytes can be told apart.

    In lockstep all chunks of a frame go out at once, and over a virtual link it shows when the next
    frame begins which of them left; in realtime an outbox sends them one by one.
    """

    def __init__(self, agent: str, bus: Bus, radio: Radio, terms: UplinkContext) -> None:
        self.agent = agent
        self.bus = bus
        self.radio = radio
        self._terms = terms
        self._plans = Plans()
        self._frame = -1
        self._outbox = None if terms.lockstep else Outbox(agent)
        self._under_way: FrameUpload | None = None
        self._done: list[FrameUpload] = []
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

    def receive(self, plan: Plan) -> None:
        """Takes the edge's plan; an older one than the newest is left."""
        published_ns = plan.enough_sim_ns
        arrival_ns = 0 if published_ns is None else self.radio.reception_ns(published_ns)
        is_taken = self._plans.receive(plan, frame=self._frame, arrival_sim_ns=arrival_ns)
        if is_taken and self._outbox is not None:
            self._outbox.receive(enough=plan.enough, mbps=plan.mbps)

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

    def ship(self, shipment: FrameUpload) -> None:
        """Sends a frame's chunks, or has the outbox do so."""
        if self._outbox is not None:
            self._outbox.put(shipment)
            return
        for chunk in range(shipment.chunks):
            shipment.send(chunk)
        self.keep(shipment)

    def keep(self, shipment: FrameUpload) -> None:
        """Keeps a frame that was sent at once, until it shows what became of it."""
        if self.radio.is_virtual:
            self._under_way = shipment
        else:
            self._done.append(shipment)

    def send(self, shipment: FrameUpload, message: Scan | Objects, begun_ns: int) -> int:
        """Sends a part of a shipment that was being made since then; returns its size in bytes.

        Over a virtual link, its arrival is added to the message.
        """
        part = _Sent.of(message)
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
                link_sim_ns=passage and passage.latency_ns,
            )
        )
        return sent_bytes

    def take_done(self) -> list[FrameUpload]:
        """Returns the frames of which nothing more will be sent, once."""
        done, self._done = self._done, []
        if self._outbox is not None:
            done += [s for s in self._outbox.take_done() if isinstance(s, FrameUpload)]
        return done

    def take_wire_counts(self, frame: int | None = None) -> list[WireCount]:
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
class _Sent:
    """What is booked of a message; it was made at `made_ns`."""

    topic: str
    chunk: int
    points: int
    payload_bytes: int
    made_ns: int

    @classmethod
    def of(cls, message: Scan | Objects) -> _Sent:
        if isinstance(message, Scan):
            size_bytes, made_ns = message.payload.size, message.encode_end_ns
            return cls("scan", message.chunk, message.points, size_bytes, made_ns)
        size_bytes = message.boxes.nbytes + message.scores.nbytes
        return cls("objects", 0, len(message.boxes), size_bytes, message.detect_end_ns)
