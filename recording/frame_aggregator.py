"""Aggregates the last few frames from the messages of many processes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from protocol.errors import MessageError
from protocol.instances import WORLD_HOST, region_of, role_of
from protocol.messages import LaneCounts, Metrics, Span, Upload, WireCount
from recording.latency_breakdown import Clocks, FrameTimings
from recording.limits import MAX_ALL_ENTRIES, MAX_ENTRIES, MAX_OPEN_FRAMES, MAX_WIRED
from recording.tables import FrameRow, LatencyRow, RegionFrameRow, UploadRow


class TickCheck:
    """Checks the sequence of ticks; a jump is accepted when the next tick continues it."""

    def __init__(self, period_ns: int, last: tuple[int, int] | None = None) -> None:
        """Starts after the last known tick, frame and ns of simulation."""
        self._period_ns = period_ns
        self._last = last
        self._doubted: tuple[int, int] | None = None
        self.frame = last[0] if last else -1

    def take(self, frame: int, sim_time_ns: int) -> None:
        """Advances to a tick.

        Raises:
            MessageError: it follows neither the last one nor a pending jump.
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


_NOBODY: tuple[None, ...] = (None,) * 9


@dataclass(slots=True)
class RegionRecord:
    """The data of one frame of one region so far."""

    timings: FrameTimings
    agents: set[str] | None = None
    points: int | None = None
    detections: int | None = None
    complete: bool | None = None
    border_bytes: int | None = None
    request_ns: int | None = None

    def counted(self, lanes: LaneCounts) -> None:
        """Adds the counts of the region's edge."""
        self.complete, self.agents = lanes.complete, set(lanes.agents)
        self.timings.complete = lanes.complete
        self.timings.delay_sim_ns = lanes.delay_sim_ns

    def requested(self, received_ns: int) -> None:
        """Registers that a request for one of its signals came."""
        self.request_ns = received_ns

    def end_to_end_ns(
        self, latencies: list[LatencyRow], clocks: Clocks, tick_ns: int | None
    ) -> int | None:
        """From the first sensing until the last signal cabinet has acted.

        Where no scan was used, of the scans that were not; where there was none, from the tick.
        """
        if latencies:
            return max(latency.end_to_end_ns for latency in latencies)
        return self.timings.unused_end_to_end_ns(clocks, tick_ns)


@dataclass(slots=True)
class FrameRecord:
    """The data of one frame so far, of the world and of each region."""

    frame: int
    sim_time_ns: int | None = None
    vehicles: int | None = None
    cavs: int | None = None
    cvs: int | None = None
    tick_ns: int | None = None
    wire: dict[str, WireCount] = field(default_factory=dict)
    agent_spans: dict[str, list[Span]] = field(default_factory=lambda: defaultdict(list))
    regions: dict[str, RegionRecord] = field(default_factory=dict)
    received: set[str] = field(default_factory=set)
    entries: int = 0

    def region(self, region: str) -> RegionRecord:
        """Returns the record of a region, to be changed by the caller."""
        known = self.regions.get(region)
        if known is None:
            known = self.regions[region] = RegionRecord(FrameTimings(region, self.agent_spans))
        return known

    def measured(self, metrics: Metrics, region_of_tls: Mapping[str, str]) -> None:
        """Adds the metrics of one process in this frame.

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
        role, region = role_of(metrics.process), region_of(metrics.process)
        if role == WORLD_HOST:
            for span in metrics.spans:
                if span.stage == "actuate" and span.agent in region_of_tls:
                    self.region(region_of_tls[span.agent]).timings.actuations.append(span)
        elif role == "edge":
            self._measured_by_edge(metrics, self.region(region))
        elif role == "signal":
            self.region(region).timings.signal += metrics.spans
        else:
            self._measured_by_agents(metrics, region_of_tls.values())

    def _measured_by_edge(self, metrics: Metrics, record: RegionRecord) -> None:
        record.points, record.border_bytes = metrics.points, metrics.border_bytes
        record.timings.edge += metrics.spans
        for arrival in metrics.arrivals:
            record.timings.arrivals[arrival.agent, arrival.chunk] = arrival

    def _measured_by_agents(self, metrics: Metrics, regions: Collection[str]) -> None:
        for span in metrics.spans:
            self.agent_spans[span.agent].append(span)
        for upload in metrics.uploads:
            if upload.region in regions:
                timings = self.region(upload.region).timings
                timings.senders[upload.agent] = metrics.process
                timings.uploads[upload.agent, upload.chunk] = upload

    def wired(self, count: WireCount) -> None:
        """Adds the bytes on an agent's link; agents beyond the limit are ignored."""
        if count.agent in self.wire or len(self.wire) < MAX_WIRED:
            self.wire[count.agent] = count

    def rows(self, clocks: Clocks) -> FrameRows:
        """Returns the frame as rows of all its tables."""
        latencies: list[LatencyRow] = []
        regions: list[RegionFrameRow] = []
        for name, record in sorted(self.regions.items()):
            found = record.timings.latencies(self.frame, clocks)
            latencies += found
            regions.append(
                RegionFrameRow(
                    frame=self.frame,
                    region=name,
                    agents=None if record.agents is None else len(record.agents),
                    points=record.points,
                    detections=record.detections,
                    complete=None if record.complete is None else int(record.complete),
                    border_bytes=record.border_bytes,
                    request_ns=record.request_ns,
                    end_to_end_ns=record.end_to_end_ns(found, clocks, self.tick_ns),
                )
            )
        return FrameRows(self._row(regions), regions, latencies, list(self._upload_rows()))

    def _row(self, regions: list[RegionFrameRow]) -> FrameRow:
        agents = [one.agents for one in self.regions.values() if one.agents is not None]
        return FrameRow(
            self.frame,
            self.sim_time_ns,
            self.vehicles,
            self.cavs,
            self.cvs,
            len(set[str]().union(*agents)) if agents else None,
            _over(sum, (row.points for row in regions)),
            _over(sum, (row.detections for row in regions)),
            _over(min, (row.complete for row in regions)),
            self.tick_ns,
            _over(max, (row.request_ns for row in regions)),
            _over(max, (row.end_to_end_ns for row in regions)),
        )

    def _upload_rows(self) -> Iterator[UploadRow]:
        """Returns a row per chunk in the metrics of its sender or of an edge.

        TCP's bytes of an agent's frame stand at its first chunk.
        """
        wire = dict(self.wire)
        for name, record in sorted(self.regions.items()):
            uploads, arrivals = record.timings.uploads, record.timings.arrivals
            for key in sorted(uploads.keys() | arrivals.keys()):
                sent, came = uploads.get(key), arrivals.get(key)
                sender = _NOBODY if sent is None else _as_sent(sent, wire.pop(key[0], None))
                edge = (None, None) if came is None else (came.received_ns, came.decoded_ns)
                yield UploadRow(self.frame, name, *key, *sender, *edge)


@dataclass(frozen=True, slots=True)
class FrameRows:
    """The rows of one frame by table."""

    frame: FrameRow
    regions: list[RegionFrameRow]
    latencies: list[LatencyRow]
    uploads: list[UploadRow]


def _over(function: Callable[[list[int]], int], values: Iterable[int | None]) -> int | None:
    """Applies a function to the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return function(known) if known else None


class FrameAggregator:
    """Aggregates the newest frames; a frame is written again whenever more of it was received."""

    def __init__(
        self,
        frame_period_ns: int,
        regions: Mapping[str, Sequence[str]],
        last_tick: tuple[int, int] | None = None,
    ) -> None:
        """Starts after a resumed recording's last tick, frame and ns of simulation.

        `regions` are the signals of each region.
        """
        self._region_of_tls = {tls: name for name, signals in regions.items() for tls in signals}
        self._notes: dict[int, FrameRecord] = {}
        self._changed: set[int] = set()
        self._entries = 0  # of all records
        self._tick_check = TickCheck(frame_period_ns, last_tick)
        self._settled = -1

    def __len__(self) -> int:
        return len(self._notes)

    @property
    def newest_tick(self) -> int:
        """The frame that the world began last, -1 before the first."""
        return self._tick_check.frame

    def tick(self, frame: int, sim_time_ns: int) -> FrameRecord:
        """Returns the record of a frame that the world has begun.

        Raises:
            MessageError: it does not follow the ticks so far.
        """
        self._tick_check.take(frame, sim_time_ns)
        return self.note(frame)

    def note(self, frame: int) -> FrameRecord:
        """Returns the record of a frame, to be changed by the caller.

        Raises:
            MessageError: the frame is settled, or far ahead of the world.
        """
        self.check(frame)
        self._changed.add(frame)
        return self._notes.setdefault(frame, FrameRecord(frame))

    def measured(self, metrics: Metrics) -> FrameRecord:
        """Adds a process's metrics to the record of a frame, and returns it.

        Raises:
            MessageError: as `note`, or the frame, or all of them, have no room for more.
        """
        note = self.note(metrics.frame)
        if self._entries > MAX_ALL_ENTRIES:
            raise MessageError(f"open frames have more than {MAX_ALL_ENTRIES} entries")
        before = note.entries
        note.measured(metrics, self._region_of_tls)
        self._entries += note.entries - before
        for count in metrics.wire:
            self.note(count.frame).wired(count)
        return note

    def signal_region(self, frame: int, tls: str) -> RegionRecord:
        """Returns the record of the region of a signal.

        Raises:
            MessageError: as `note`, or no region has that signal.
        """
        if tls not in self._region_of_tls:
            raise MessageError(f"no region has the signal {tls}")
        return self.note(frame).region(self._region_of_tls[tls])

    def region(self, frame: int, region: str) -> RegionRecord:
        """Returns the record of a region.

        Raises:
            MessageError: as `note`, or there is no such region.
        """
        if region not in self._region_of_tls.values():
            raise MessageError(f"there is no region {region}")
        return self.note(frame).region(region)

    def check(self, frame: int) -> None:
        """Raises MessageError if a frame is settled, or far ahead of the world."""
        if abs(frame - self.newest_tick) > MAX_OPEN_FRAMES:
            raise MessageError(f"frame {frame} is too far from the world's {self.newest_tick}")
        if frame <= self._settled:
            raise MessageError(f"frame {frame} was recorded before the recorder broke off")

    def settle(self, frame: int) -> None:
        """Closes a frame and all before it: their records no longer change."""
        self._settled = frame

    def get(self, frame: int) -> FrameRecord | None:
        """Returns the record of a frame, read-only, if it is open."""
        return self._notes.get(frame)

    def take_changed(self) -> list[FrameRecord]:
        """Returns the records that changed since the last call, and forgets the settled ones."""
        changed = [self._notes[frame] for frame in sorted(self._changed)]
        self._changed.clear()
        for frame in [f for f in self._notes if abs(f - self.newest_tick) > MAX_OPEN_FRAMES]:
            self._entries -= self._notes.pop(frame).entries
        return changed


def _as_sent(upload: Upload, wire: WireCount | None) -> tuple[int | None, ...]:
    return (
        upload.points,
        upload.payload_bytes,
        None if wire is None else wire.sent_bytes,
        None if wire is None else wire.received_bytes,
        upload.sense_start_ns,
        upload.sense_end_ns,
        upload.encode_end_ns,
        upload.sent_ns,
        upload.link_sim_ns,
    )
