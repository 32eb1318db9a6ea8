"""Figures over time: each agent's upload rate, and the latency breakdown by stage."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from protocol.errors import MessageError
from protocol.messages import ClockReading, LaneCounts, Message, Metrics, Tick
from recording.frame_aggregator import FrameAggregator
from recording.tables import LatencyRow

LAG_FRAMES = 3
"""Lag after which all metrics of a frame have arrived."""
WINDOW_NS = 1_000_000_000
MAX_RATED_AGENTS = 1024
_MAX_FRAMES = 256  # of the window


def uploads_to(metrics: Metrics, regions: Collection[str]) -> Metrics:
    """Returns a process's metrics with the uploads to these regions alone."""
    uploads = [upload for upload in metrics.uploads if upload.region in regions]
    return metrics.model_copy(update={"uploads": uploads})


class Rates:
    """Adds up each agent's payloads over the last second whose frames are complete."""

    def __init__(self, frame_period_ns: int) -> None:
        self._period_ns = frame_period_ns
        self._window_ns = max(WINDOW_NS, frame_period_ns)
        self._sent: dict[str, deque[tuple[int, int]]] = {}

    def take(self, metrics: Metrics) -> None:
        """Adds a process's metrics of sent chunks; agents beyond the limit are ignored."""
        at_ns = metrics.sim_time_ns
        for upload in metrics.uploads:
            if upload.agent not in self._sent and len(self._sent) >= MAX_RATED_AGENTS:
                continue
            sent = self._sent.setdefault(upload.agent, deque(maxlen=_MAX_FRAMES))
            before = sent.pop()[1] if sent and sent[-1][0] == at_ns else 0
            sent.append((at_ns, before + upload.payload_bytes))

    def mbps(self, now_ns: int) -> dict[str, float]:
        """Returns each agent's rate, as of `LAG_FRAMES` before now, without idle agents.

        An agent that came within the second has the rate since then.
        """
        end_ns = now_ns - LAG_FRAMES * self._period_ns
        rates = {}
        for agent, sent in list(self._sent.items()):
            while sent and sent[0][0] <= end_ns - self._window_ns:
                sent.popleft()
            if not sent:
                del self._sent[agent]
            elif (since_ns := end_ns - sent[0][0]) >= 0:
                heard_ns = min(self._window_ns, since_ns + self._period_ns)
                known_bytes = sum(size for at_ns, size in sent if at_ns <= end_ns)
                rates[agent] = known_bytes * 8e3 / heard_ns
        return rates


MAX_PROCESSES = 512
GROUPS = {
    "sense": ("sense",),
    "encode": ("select", "encode", "send"),
    "link": ("link",),
    "decode": ("decode", "place"),
    "wait": ("wait",),
    "ground": ("check", "merge", "ground"),
    "detect": ("detect",),
    "fuse to signal": ("fuse", "border", "track", "count", "decide", "actuate"),
    "other": ("other",),
}
"""Groups of stages as they are drawn, in order; short or related stages share a group."""


@dataclass(frozen=True, slots=True)
class FrameLatency:
    """The critical path of a frame: milliseconds by group of stages, and end to end."""

    frame: int
    sim_time_ns: int
    groups_ms: dict[str, float]
    end_to_end_ms: float


class Stages:
    """Computes the latency breakdown of frames as the recorder does."""

    def __init__(self, frame_period_ns: int, regions: Mapping[str, Sequence[str]]) -> None:
        """Takes the signals of each region."""
        self._aggregator = FrameAggregator(frame_period_ns, regions)
        self._clocks: dict[str, tuple[int, int]] = {}
        self._told = -1

    def take(self, message: Message) -> None:
        """Adds a message with times.

        Raises:
            MessageError: its frame is implausible.
        """
        match message:
            case Tick():
                note = self._aggregator.tick(message.frame, message.sim_time_ns)
                note.sim_time_ns = message.sim_time_ns
            case Metrics():
                self._aggregator.measured(message)
            case LaneCounts():
                self._aggregator.signal_region(message.frame, message.tls).counted(message)
            case ClockReading():
                self._hear(message)

    def latencies(self) -> Iterator[dict[str, FrameLatency]]:
        """Yields the frames whose times are known since the last call, by region."""
        self._aggregator.take_changed()
        newest = self._aggregator.newest_tick - LAG_FRAMES
        first = max(self._told + 1, newest - LAG_FRAMES)
        for frame in range(first, newest + 1):
            note = self._aggregator.get(frame)
            if note is None or note.sim_time_ns is None:
                continue
            found: dict[str, FrameLatency] = {}
            rows = note.rows(self._clocks).latencies
            for row in sorted(rows, key=lambda row: -row.end_to_end_ns):
                if row.region not in found:
                    found[row.region] = _frame_latency(row, note.sim_time_ns)
            if found:
                yield found
        self._told = max(self._told, newest)

    def _hear(self, reading: ClockReading) -> None:
        if reading.process not in self._clocks and len(self._clocks) >= MAX_PROCESSES:
            raise MessageError(f"{reading.process} is one process more than {MAX_PROCESSES}")
        self._clocks[reading.process] = reading.offset_ns, reading.error_ns


def slowest(latencies: Mapping[str, FrameLatency]) -> FrameLatency:
    """Returns the slowest of at least one region."""
    return max(latencies.values(), key=lambda latency: latency.end_to_end_ms)


def _frame_latency(row: LatencyRow, sim_time_ns: int) -> FrameLatency:
    took_ns = row._asdict()
    groups_ms = {
        group: sum(took_ns[f"{stage}_ns"] for stage in stages) / 1e6
        for group, stages in GROUPS.items()
    }
    return FrameLatency(row.frame, sim_time_ns, groups_ms, row.end_to_end_ns / 1e6)
