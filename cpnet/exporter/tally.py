"""What the processes of a run say of themselves, summed up.

One thread tells, another one asks: each holds the lock meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from cpnet.crowd import Who
from cpnet.exporter.counts import Histogram
from cpnet.exporter.names import OTHER, Names
from cpnet.processes import ProcessEntry
from protocol.inbox import Envelope, Presence
from protocol.messages import Metrics, Progress, Span
from protocol.rising import Rising
from protocol.topics import ROLES

MAX_PROCESSES = 256
MAX_REASONS = 64
MAX_STAGES = 32
LONGEST_NS = 60_000_000_000  # what says that it took longer is no time
SUPERVISOR = "up"


@dataclass(slots=True)
class Glimpse:
    """The newest `Progress`, when it came, and since when the signal has shown its state."""

    progress: Progress
    heard_ns: int
    state_since_sim_ns: int

    @property
    def state_age_ns(self) -> int:
        """Simulated time for which the signal has shown its state, 0 if the world began anew."""
        return max(0, self.progress.sim_time_ns - self.state_since_sim_ns)


@dataclass(slots=True, eq=False)
class Tally:
    """All that is exported. Labels are bounded, whatever comes."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    glimpse: Glimpse | None = None
    acted_ns: int | None = None
    frames: int = 0
    odd_spans: int = 0
    stages: dict[str, Histogram] = field(default_factory=lambda: defaultdict(Histogram))
    uploaded_bytes: Counter[str] = field(default_factory=Counter)
    sent_bytes: Counter[str] = field(default_factory=Counter)
    drops: dict[str, Rising] = field(default_factory=lambda: defaultdict(Rising))
    present: dict[tuple[str, str], bool] = field(default_factory=dict)
    restarts: Counter[str] = field(default_factory=Counter)
    _expected: set[Who] = field(default_factory=set)
    _processes: Names = field(default_factory=lambda: Names(MAX_PROCESSES))
    _reasons: Names = field(default_factory=lambda: Names(MAX_REASONS))
    _stages: Names = field(default_factory=lambda: Names(MAX_STAGES))

    def expect(self, entries: Iterable[ProcessEntry], elsewhere: Iterable[Who] = ()) -> None:
        """Counts processes as down until they show themselves; keeps places for those elsewhere."""
        with self.lock:
            here = [self._who(entry.role.role, entry.id) for entry in entries]
            self.present.update(dict.fromkeys(here, False))
            self._expected.update(here, (self._who(*who) for who in elsewhere))

    def restarted(self, process: str) -> None:
        """Counts a process that was started again after its end."""
        with self.lock:
            name = self._processes.label(process)
            self.restarts[name] += 1
            self.drops[name].restart()

    def lost(self, drops: Mapping[str, int]) -> None:
        """Takes what the supervisor itself could not read, since its start."""
        with self.lock:
            self._count_drops(SUPERVISOR, drops)

    def take(self, item: Envelope | Presence) -> None:
        """Takes what came over the world bus; what says nothing of the run is left."""
        with self.lock:
            if isinstance(item, Presence):
                self._meet(item)
            elif isinstance(item.message, Progress):
                self._glimpse(item.message)
            elif isinstance(item.message, Metrics):
                self._measure(item.message)

    def _meet(self, presence: Presence) -> None:
        who = self._who(presence.role, presence.id)
        if presence.alive or who in self._expected:
            self.present[who] = presence.alive
            return
        self.present.pop(who, None)
        process = who[1]
        if process not in {name for _, name in self._expected.union(self.present)}:
            self._forget(process)

    def _forget(self, process: str) -> None:
        """Makes room, for anybody may invent processes; what is told as `other` goes on."""
        if process != OTHER:
            for counts in (self.uploaded_bytes, self.sent_bytes, self.restarts, self.drops):
                counts.pop(process, None)
            self._processes.release(process)

    def _glimpse(self, progress: Progress) -> None:
        last, since_ns = self.glimpse, progress.sim_time_ns
        if last is not None and last.progress.state == progress.state:
            since_ns = last.state_since_sim_ns
        self.glimpse = Glimpse(progress, time.monotonic_ns(), since_ns)

    def _measure(self, metrics: Metrics) -> None:
        process = self._processes.label(metrics.process)
        for span in metrics.spans:
            self._span(span)
        if metrics.uploads:
            payload = sum(upload.payload_bytes for upload in metrics.uploads)
            self.uploaded_bytes[process] += payload
        if metrics.wire:
            self.sent_bytes[process] += sum(count.sent_bytes for count in metrics.wire)
        self._count_drops(process, metrics.drops)

    def _span(self, span: Span) -> None:
        took_ns = span.end_ns - span.start_ns
        if not 0 <= took_ns <= LONGEST_NS:
            self.odd_spans += 1
            return
        self.stages[self._stages.label(span.stage)].add(took_ns)
        if span.stage == "world":
            self.frames += 1
        elif span.stage == "actuate":
            self.acted_ns = time.monotonic_ns()

    def _count_drops(self, process: str, drops: Mapping[str, int]) -> None:
        if not drops and process not in self.drops:
            return
        told: Counter[str] = Counter()
        for reason, count in drops.items():
            told[self._reasons.label(reason)] += count
        rising = self.drops[process]
        (rising.take_highest if process == OTHER else rising.take)(told)

    def _who(self, role: str, process: str) -> tuple[str, str]:
        return role if role in ROLES else OTHER, self._processes.label(process)
