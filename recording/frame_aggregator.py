"""Aggregates the last few frames from the messages of many processes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from protocol.errors import MessageError
from protocol.messages import LaneCounts, Metrics, Upload
from recording.latency_breakdown import FrameTimings
from recording.limits import MAX_ALL_ENTRIES, MAX_ENTRIES, MAX_OPEN_FRAMES, MAX_WIRED
from recording.tables import FrameRow, LatencyRow, UploadRow


class TickCheck:
    """Follows ticks; one that leads elsewhere is believed when the next goes on from there."""

    def __init__(self, period_ns: int, last: tuple[int, int] | None = None) -> None:
        """Begins after the last tick, frame and ns of simulation, that is known from before."""
        self._period_ns = period_ns
        self._last = last
        self._doubted: tuple[int, int] | None = None
        self.frame = last[0] if last else -1

    def take(self, frame: int, sim_time_ns: int) -> None:
        """Moves on to a tick.

        Raises:
            MessageError: it follows neither the last one nor one that was doubted.
        """
        tick = frame, sim_time_ns
        if not (self._goes_on(self._last, tick) or self._goes_on(self._doubted, tick)):
            self._doubted = tick
            raise MessageError(
                f"tick {frame} at {sim_time_ns / 1e9:g} s does not follow {self.frame}"
            )
        self._last, self._doubted, self.frame = tick, None, frame

    def _goes_on(self, before: tuple[int, int] | None, tick: tuple[int, int]) -> bool:
        frames = tick[0] - (before[0] if before else -1)
        if before is None:
            return self._last is None and frames <= MAX_OPEN_FRAMES
        due_ns = frames * self._period_ns  # SUMO rounds its steps to milliseconds
        return 0 < frames <= MAX_OPEN_FRAMES and due_ns / 2 <= tick[1] - before[1] <= 2 * due_ns


Clocks = Mapping[str, tuple[int, int]]
_NOBODY: tuple[None, ...] = (None,) * 8


@dataclass(slots=True)
class FrameRecord:
    """What is known of one frame so far."""

    frame: int
    sim_time_ns: int | None = None
    vehicles: int | None = None
    cavs: int | None = None
    cvs: int | None = None
    agents: int | None = None
    points: int | None = None
    detections: int | None = None
    complete: bool | None = None
    tick_ns: int | None = None
    request_ns: int | None = None
    wire: dict[str, int] = field(default_factory=dict)
    evidence: FrameTimings = field(default_factory=FrameTimings)
    received: set[str] = field(default_factory=set)
    entries: int = 0

    def measured(self, metrics: Metrics) -> None:
        """Adds what one process measured in this frame.

        Raises:
            MessageError: the frame has more messages than there is room for.
        """
        more = 1 + len(metrics.spans) + len(metrics.uploads) + len(metrics.arrivals)
        if self.entries + more > MAX_ENTRIES:
            raise MessageError(
                f"frame {self.frame} has {self.entries} entries, limit {MAX_ENTRIES}"
            )
        self.entries += more
        self.received.add(metrics.process)
        known = self.evidence
        known.spans[metrics.process] += metrics.spans
        known.senders |= {upload.agent: metrics.process for upload in metrics.uploads}
        known.uploads |= {(upload.agent, upload.chunk): upload for upload in metrics.uploads}
        known.arrivals |= {(arrival.agent, arrival.chunk): arrival for arrival in metrics.arrivals}
        if metrics.process == "edge":
            self.points = metrics.points

    def wired(self, agent: str, sent_bytes: int) -> None:
        """Adds what TCP sent for an agent; of too many agents no more are noted."""
        if agent in self.wire or len(self.wire) < MAX_WIRED:
            self.wire[agent] = sent_bytes

    def counted(self, lanes: LaneCounts) -> None:
        """Adds what the edge made of the frame."""
        self.complete, self.agents = lanes.complete, len(lanes.agents)
        self.evidence.complete = lanes.complete
        self.evidence.delay_sim_ns = lanes.delay_sim_ns

    def latencies(self, clocks: Clocks) -> list[LatencyRow]:
        """Returns where the frame's time went, by agent."""
        return self.evidence.latencies(self.frame, clocks)

    def end_to_end_ns(self, clocks: Clocks) -> int | None:
        """From the first sensing until the signal cabinet has acted.

        Where no scan was used, of the scans that were not; where there was none, from the tick.
        """
        latencies = self.latencies(clocks)
        if latencies:
            return max(latency.end_to_end_ns for latency in latencies)
        return self.evidence.unused_end_to_end_ns(clocks, self.tick_ns)

    def row(self, clocks: Clocks) -> FrameRow:
        """Returns the frame as a row."""
        return FrameRow(
            self.frame,
            self.sim_time_ns,
            self.vehicles,
            self.cavs,
            self.cvs,
            self.agents,
            self.points,
            self.detections,
            None if self.complete is None else int(self.complete),
            self.tick_ns,
            self.request_ns,
            self.end_to_end_ns(clocks),
        )

    def upload_rows(self) -> Iterator[UploadRow]:
        """Returns a row per chunk that its sender or the edge spoke of.

        TCP's bytes of an agent's frame stand at its first chunk.
        """
        uploads, arrivals, wire = self.evidence.uploads, self.evidence.arrivals, dict(self.wire)
        for key in sorted(uploads.keys() | arrivals.keys()):
            sent, came = uploads.get(key), arrivals.get(key)
            sender = _NOBODY if sent is None else _as_sent(sent, wire.pop(key[0], None))
            edge = (None, None) if came is None else (came.received_ns, came.decoded_ns)
            yield UploadRow(self.frame, *key, *sender, *edge)


class FrameAggregator:
    """Notes of the newest frames; a frame is written again whenever more was heard of it."""

    def __init__(self, frame_period_ns: int, last_tick: tuple[int, int] | None = None) -> None:
        """Begins after a recording's last tick, frame and ns of simulation, if it goes on."""
        self._notes: dict[int, FrameRecord] = {}
        self._changed: set[int] = set()
        self._entries = 0  # of all notes
        self._tick_check = TickCheck(frame_period_ns, last_tick)
        self._settled = -1

    def __len__(self) -> int:
        return len(self._notes)

    @property
    def newest_tick(self) -> int:
        """The frame that the world began last, -1 before the first."""
        return self._tick_check.frame

    def tick(self, frame: int, sim_time_ns: int) -> FrameRecord:
        """Returns the note of a frame that the world has begun.

        Raises:
            MessageError: it does not follow the ticks so far.
        """
        self._tick_check.take(frame, sim_time_ns)
        return self.note(frame)

    def note(self, frame: int) -> FrameRecord:
        """Returns the note of a frame, to be changed by the caller.

        Raises:
            MessageError: the frame is settled, or far ahead of the world.
        """
        self.check(frame)
        self._changed.add(frame)
        return self._notes.setdefault(frame, FrameRecord(frame))

    def measured(self, metrics: Metrics) -> FrameRecord:
        """Returns the note of a frame with what one process measured in it.

        Raises:
            MessageError: as `note`, or the frame, or all of them, have no room for more.
        """
        note = self.note(metrics.frame)
        if self._entries > MAX_ALL_ENTRIES:
            raise MessageError(f"open frames have more than {MAX_ALL_ENTRIES} entries")
        before = note.entries
        note.measured(metrics)
        self._entries += note.entries - before
        for count in metrics.wire:
            self.note(count.frame).wired(count.agent, count.sent_bytes)
        return note

    def check(self, frame: int) -> None:
        """Raises MessageError if a frame is settled, or far ahead of the world."""
        if abs(frame - self.newest_tick) > MAX_OPEN_FRAMES:
            raise MessageError(f"frame {frame} is too far from the world's {self.newest_tick}")
        if frame <= self._settled:
            raise MessageError(f"frame {frame} was recorded before the recorder broke off")

    def settle(self, frame: int) -> None:
        """Closes a frame and all before it: what was recorded of them stays as it is."""
        self._settled = frame

    def get(self, frame: int) -> FrameRecord | None:
        """Returns the note of a frame to look at, if it is open."""
        return self._notes.get(frame)

    def take_changed(self) -> list[FrameRecord]:
        """Returns the notes that changed since the last call, and forgets the settled ones."""
        changed = [self._notes[frame] for frame in sorted(self._changed)]
        self._changed.clear()
        for frame in [f for f in self._notes if abs(f - self.newest_tick) > MAX_OPEN_FRAMES]:
            self._entries -= self._notes.pop(frame).entries
        return changed


def _as_sent(upload: Upload, wire_bytes: int | None) -> tuple[int | None, ...]:
    return (
        upload.points,
        upload.payload_bytes,
        wire_bytes,
        upload.sense_start_ns,
        upload.sense_end_ns,
        upload.encode_end_ns,
        upload.sent_ns,
        upload.link_sim_ns,
    )
