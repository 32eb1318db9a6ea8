"""An agent's uplink to the edge: upload plans, send queue and the record of sent chunks."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from protocol.bus import Bus
from protocol.errors import CpnetError
from protocol.messages import Objects, Plan, Scan, Span, Upload, WireCount
from protocol.traffic import Traffic
from sensing.limits import MAX_AGE_FRAMES, MAX_AHEAD_FRAMES
from sensing.radio import ENVELOPE_BYTES, Radio
from sensing.world_view import WorldView


@dataclass(frozen=True, slots=True, eq=False)
class _ReceivedPlan:
    """A plan, and when it arrived over a virtual link; 0 where links are real."""

    plan: Plan
    arrival_sim_ns: int


class PlanHistory:
    """The edge's plans of the last frames. A plan holds from its frame on."""

    def __init__(self) -> None:
        self._received: list[_ReceivedPlan] = []

    @property
    def newest(self) -> Plan | None:
        """The newest plan; its frame may still be to come."""
        return self._received[-1].plan if self._received else None

    def receive(self, plan: Plan, *, frame: int, arrival_sim_ns: int) -> bool:
        """Takes a plan during a frame; returns False for one that is older or too far ahead."""
        newest = self.newest
        is_news = newest is None or plan.frame > newest.frame
        if not is_news or plan.frame > frame + MAX_AHEAD_FRAMES:
            return False
        self._received = [h for h in self._received if h.plan.frame >= frame - MAX_AGE_FRAMES]
        self._received.append(_ReceivedPlan(plan, arrival_sim_ns))
        return True

    def of(self, frame: int, sim_time_ns: int) -> Plan | None:
        """Returns the plan to follow in a frame that begins at a time."""
        for received in reversed(self._received):
            age_frames = frame - received.plan.frame
            if 0 <= age_frames <= MAX_AGE_FRAMES and received.arrival_sim_ns <= sim_time_ns:
                return received.plan
        return None


EARLY_NS = 4_000_000  # a chunk may queue for this long, so that the uplink does not run dry
LONGEST_NS = 1_000_000_000  # a rate estimate that was wrong is tried again after this


@dataclass(frozen=True, slots=True)
class UplinkContext:
    """What all uplinks of a process share: process id, mode, frame period."""

    process: str
    lockstep: bool
    period_ns: int


@dataclass(slots=True, eq=False)
class FrameUpload:
    """One frame of one agent: the chunks to be sent, and the record of those that were."""

    view: WorldView
    uploads: list[Upload] = field(default_factory=list, kw_only=True)
    spans: list[Span] = field(default_factory=list, kw_only=True)

    @property
    def frame(self) -> int:
        """Number of the frame."""
        return self.view.frame

    @property
    def chunks(self) -> int:
        """Number of chunks to be sent."""
        raise NotImplementedError

    def send(self, chunk: int) -> int:
        """Sends a chunk; returns its size in bytes."""
        raise NotImplementedError


class Outbox:
    """Send queue of one agent: sends the newest frame's chunks as fast as its uplink takes them.

    A thread per agent, so that a slow uplink delays no other agent. The next chunk goes out when,
    by the edge's estimate of the uplink's rate, those before it have left, so that no more than
    about one chunk ever queues in the transport. It does not go out at all once a newer frame is
    there or the edge has completed the frame. A slow uplink thus sends fewer chunks of each frame,
    then fewer frames, each of them recent. `unsent` counts the chunks that a newer frame replaced.
    """

    def __init__(self, agent: str) -> None:
        self._turn = threading.Condition()
        self._next: FrameUpload | None = None
        self._enough = -1
        self._mbps = 0.0
        self._free_ns = 0
        self._closed = False
        self._error: CpnetError | None = None
        self._done: list[FrameUpload] = []
        self.unsent = 0
        self._thread = threading.Thread(target=self._run, name=f"outbox {agent}", daemon=True)
        self._thread.start()

    def put(self, upload: FrameUpload) -> None:
        """Takes the newest frame; it replaces the unsent chunks of the frame before.

        Raises:
            CpnetError: the error that sending the last frame failed with.
        """
        with self._turn:
            if self._error is not None:
                raise self._error
            if self._next is not None:
                self.unsent += self._next.chunks
            self._next = upload
            self._turn.notify()

    def receive(self, *, enough: int, mbps: float) -> None:
        """Updates the last completed frame, and the estimated rate, 0 if it is unknown."""
        with self._turn:
            self._enough, self._mbps = max(enough, self._enough), mbps
            self._turn.notify()

    def take_done(self) -> list[FrameUpload]:
        """Returns the frames of which nothing more will be sent, once."""
        with self._turn:
            done, self._done = self._done, []
        return done

    def close(self) -> None:
        """Stops sending; waits a second for a chunk that is being sent."""
        with self._turn:
            self._closed = True
            self._turn.notify()
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            while (upload := self._take()) is not None:
                self._send_chunks(upload)
                with self._turn:
                    self._done.append(upload)
        except CpnetError as error:
            with self._turn:
                self._error = error

    def _take(self) -> FrameUpload | None:
        with self._turn:
            self._turn.wait_for(lambda: self._closed or self._next is not None)
            upload, self._next = self._next, None
            return None if self._closed else upload

    def _send_chunks(self, upload: FrameUpload) -> None:
        for chunk in range(upload.chunks):
            if not self._wait_for_turn(upload.frame):
                with self._turn:
                    left_behind = self._next is not None and self._enough < upload.frame
                    self.unsent += (upload.chunks - chunk) * left_behind
                return
            size_bytes = upload.send(chunk)
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


class Uplink:
    """An agent's channel to the edges of its regions; its connection is its own: bytes are counted.

    In lockstep all chunks of a frame are sent at once; over a virtual link, those that have not
    left when the next frame begins are recalled. In realtime an outbox sends them one by one.
    """

    def __init__(self, agent: str, bus: Bus, radio: Radio, context: UplinkContext) -> None:
        self.agent = agent
        self.bus = bus
        self.radio = radio
        self._context = context
        self._plans: dict[str, PlanHistory] = {}
        self._frame = -1
        self._outbox = None if context.lockstep else Outbox(agent)
        self._in_flight: FrameUpload | None = None
        self._done: list[FrameUpload] = []
        self._recalled = 0
        self._counted = Traffic()
        self._apportioned = Traffic()
        self._counted_frame: int | None = None

    @property
    def completed_frame(self) -> int:
        """The last frame that all its edges have completed, by their plans; -1 before the first."""
        newest = [plans.newest for plans in self._plans.values()]
        return min((-1 if plan is None else plan.enough for plan in newest), default=-1)

    @property
    def unsent_chunks(self) -> int:
        """Number of chunks that were not sent because a newer frame began."""
        return self._recalled + (0 if self._outbox is None else self._outbox.unsent)

    def enter(self, regions: Iterable[str]) -> None:
        """Sends to the edges of these regions from now on; plans of others no longer count."""
        self._plans = {region: self._plans.get(region) or PlanHistory() for region in regions}

    def receive(self, plan: Plan, region: str) -> None:
        """Takes a plan of a region's edge; one that is older than the newest is ignored."""
        plans = self._plans.get(region)
        if plans is None:
            return
        published_ns = plan.enough_sim_ns
        arrival_ns = 0 if published_ns is None else self.radio.reception_ns(published_ns)
        is_taken = plans.receive(plan, frame=self._frame, arrival_sim_ns=arrival_ns)
        if is_taken and self._outbox is not None:
            # Each edge measures its own chunks alone, so that the highest estimate is the nearest.
            mbps = max(one.newest.mbps for one in self._plans.values() if one.newest is not None)
            self._outbox.receive(enough=self.completed_frame, mbps=mbps)

    def begin(self, frame: int, sim_time_ns: int) -> None:
        """Begins a frame: chunks of the last one that have not begun to leave are recalled."""
        self._frame = frame
        last, self._in_flight = self._in_flight, None
        is_complete = last is not None and self.completed_frame >= last.frame
        enough_sim_ns = self._enough_sim_ns() if is_complete else None
        recalled = self.radio.begin(sim_time_ns, enough_sim_ns)
        self._recalled += 0 if is_complete else recalled
        if last is not None:
            del last.uploads[len(last.uploads) - recalled :]
            self._done.append(last)

    def _enough_sim_ns(self) -> int | None:
        """Returns since when, on virtual links, no edge needs more of what it has completed."""
        newest = [plans.newest for plans in self._plans.values()]
        known = [p.enough_sim_ns for p in newest if p is not None and p.enough_sim_ns is not None]
        return max(known, default=None)

    def submit(self, upload: FrameUpload) -> None:
        """Sends the chunks of a frame, or hands them to the outbox."""
        if self._outbox is not None:
            self._outbox.put(upload)
            return
        for chunk in range(upload.chunks):
            upload.send(chunk)
        self.keep(upload)

    def keep(self, upload: FrameUpload) -> None:
        """Keeps a frame that was sent at once until it is known which chunks left."""
        if self.radio.is_virtual:
            self._in_flight = upload
        else:
            self._done.append(upload)

    def send(self, upload: FrameUpload, message: Scan | Objects, region: str, begun_ns: int) -> int:
        """Sends a chunk, or boxes, of a frame to a region's edge; returns the size in bytes.

        Making them began at `begun_ns`. Over a virtual link, the arrival is added to the message.
        """
        part = _Sent.of(message)
        size_bytes = part.payload_bytes + ENVELOPE_BYTES
        transmission = self.radio.transmit(upload.view.sim_time_ns, size_bytes, is_chunk=True)
        if transmission is not None:
            message = message.model_copy(update={"arrival_sim_ns": transmission.arrival_ns})
        shared, chunk = (
            self._context,
            {"chunk": str(part.chunk)} if isinstance(message, Scan) else {},
        )
        where = {"region": region, "process": shared.process, "agent": self.agent, **chunk}
        sent_bytes = self.bus.publish(part.topic, message, **where)
        sent_ns = time.monotonic_ns()
        upload.spans += [
            self.span("encode", begun_ns, part.made_ns),
            self.span("send", part.made_ns, sent_ns),
        ]
        upload.uploads.append(
            Upload(
                agent=self.agent,
                region=region,
                chunk=part.chunk,
                points=part.points,
                payload_bytes=part.payload_bytes,
                sense_start_ns=message.sense_start_ns,
                sense_end_ns=message.sense_end_ns,
                encode_end_ns=part.made_ns,
                sent_ns=sent_ns,
                link_sim_ns=transmission and transmission.latency_ns,
            )
        )
        return sent_bytes

    def take_done(self) -> list[FrameUpload]:
        """Returns the frames of which nothing more will be sent, once."""
        done, self._done = self._done, []
        if self._outbox is not None:
            done += self._outbox.take_done()
        return done

    def take_wire_counts(self, frame: int | None = None) -> list[WireCount]:
        """Returns the link's traffic for the last frame, if any; `frame` begins now.

        The traffic of connecting is counted with the first frame.
        """
        last = self._counted_frame
        if last is None:
            self._counted_frame = frame
            return []
        before, self._counted = self._counted, self.radio.traffic()
        shared, self._apportioned = self._apportioned, Traffic()
        self._counted_frame = frame
        sent_bytes = self._counted.sent_bytes - before.sent_bytes + shared.sent_bytes
        received_bytes = self._counted.received_bytes - before.received_bytes
        if sent_bytes <= 0:
            return []
        return [
            WireCount(
                agent=self.agent,
                frame=last,
                sent_bytes=sent_bytes,
                received_bytes=received_bytes + shared.received_bytes,
            )
        ]

    def add_shared(self, size_bytes: int) -> None:
        """Counts this agent's part of a message that its process sent for several agents."""
        self._apportioned = self._apportioned.sent(size_bytes)

    def finish(self) -> None:
        """Stops sending; what leaves a virtual link within the last frame is still sent."""
        if self._outbox is not None:
            self._outbox.close()
        if self._in_flight is not None:
            view = self._in_flight.view
            self.begin(view.frame + 1, view.sim_time_ns + self._context.period_ns)

    def span(self, stage: str, start_ns: int, end_ns: int) -> Span:
        """Returns a span of this agent."""
        return Span(stage=stage, agent=self.agent, start_ns=start_ns, end_ns=end_ns)


@dataclass(frozen=True, slots=True)
class _Sent:
    """The record of a sent message; `made_ns` is when encoding or detection ended."""

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
