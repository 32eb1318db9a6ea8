"""A run's metrics for Prometheus (`cpnet up --metrics`): their definitions, and the HTTP page.

They are computed from messages on the world bus that the supervisor receives. Metrics of one region
or one signal are labelled so. Labels are bounded, whatever the network sends: an invalid name, or
one beyond the limit, counts as `other`.
"""

from __future__ import annotations

import math
import re
import socket
import time
from collections import Counter as Tally
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server

from cpnet.limits import MAX_PROCESSES, MAX_REASONS, MAX_REGIONS, MAX_SIGNALS, MAX_STAGES
from cpnet.processes import ProcessEntry, ProcessKey
from protocol.errors import ConfigError
from protocol.inbox import Envelope, Presence
from protocol.instances import region_of
from protocol.messages import JunctionProgress, Metrics, Progress, RegionProgress, Span
from protocol.topics import ROLES
from protocol.version import own_version

LONGEST_NS = 60_000_000_000  # a stage that claims to have taken longer is not counted
BUCKETS_S = (
    0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0,
)  # fmt: skip
OTHER = "other"
SUPERVISOR = "up"
_LABEL = re.compile(r"[A-Za-z0-9_.:-]{1,64}")
_TLS = re.compile(r"[^\x00-\x1f\x7f-\x9f]{1,200}")  # nets join many ids into one
_ADDRESS = re.compile(r"(?:(?P<host>\[[^\]\s]+\]|[^:\[\]/\s]+):)?(?P<port>\d{1,5})")
_PROGRESS = {
    "frame": "Newest frame",
    "simulated_time_seconds": "Time of that frame",
    "real_time_factor": "Simulated over real time",
    "vehicles": "Vehicles present",
    "cavs": "Of these, with a LiDAR",
    "cvs": "Of these, with a radio alone",
    "detections": "Vehicles detected in the newest frame",
    "end_to_end_seconds": "Newest, from sensing to signal",
}
_REGION_PROGRESS = {
    "region_frames": "Frames of a region that were counted in",
    "region_frames_incomplete": "Of these, those that lacked an upload",
    "region_agents": "Agents whose uploads are in its newest frame",
    "region_detections": "Vehicles that it detected in its newest frame",
    "region_uplink_mbps": "Payload of its agents, in Mbit per simulated second",
    "region_end_to_end_seconds": "Its newest, from sensing to signal",
}
_JUNCTION_PROGRESS = {
    "junction_phase": "Number of the green shown, or shown last, those of the plan first; or -1",
    "junction_vehicles": "Vehicles counted before its stop bars",
    "junction_queued": "Of these, stationary ones",
    "junction_coverage_ratio": "Share of its lanes before the stop bars that sensors cover",
    "signal_state_age_seconds": "Simulated time since the signal's state changed",
}


class LabelSet:
    """The first labels of a kind, up to a limit; all others are `other`."""

    def __init__(self, limit: int, pattern: re.Pattern[str] = _LABEL) -> None:
        self._limit = limit
        self._pattern = pattern
        self._known: set[str] = set()

    def label(self, name: str) -> str:
        """Returns the name itself, or `other` if it is odd or came too late."""
        if name not in self._known:
            if len(self._known) >= self._limit or not self._pattern.fullmatch(name):
                return OTHER
            self._known.add(name)
        return name

    def release(self, name: str) -> None:
        """Makes room for another name."""
        self._known.discard(name)


class RunMetrics:
    """The metrics of one run in a registry of their own; for one writing thread."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._expected: set[ProcessKey] = set()
        self._present: set[ProcessKey] = set()
        self._processes = LabelSet(MAX_PROCESSES)
        self._reasons = LabelSet(MAX_REASONS)
        self._stages = LabelSet(MAX_STAGES)
        self._regions = LabelSet(MAX_REGIONS)
        self._signals = LabelSet(MAX_SIGNALS, _TLS)
        self._last_drops: dict[str, Tally[str]] = {}
        self._progress: dict[str, Gauge] = {}
        self._region_progress: dict[str, Gauge] = {}
        self._junction_progress: dict[str, Gauge] = {}
        self._gauge("build_info", "The cpnet that exports this", ["version"]).labels(
            own_version()
        ).set(1)
        self._frames = self._counter("frames", "Frames that the world has finished")
        self._odd_spans = self._counter("odd_spans", "Stages with impossible times, not counted")
        self._stage = Histogram(
            "cpnet_stage_seconds",
            "Time of a stage",
            ["stage", "region"],
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self._uploaded = self._counter("uploaded_bytes", "Payload of scans", ["process", "region"])
        self._border = self._counter("border_bytes", "Sent to neighbouring edges", ["region"])
        self._request_age = self._gauge(
            "signal_request_age_seconds", "Since a request last reached the signal", ["tls"]
        )
        self._sent = self._counter(
            "sent_bytes", "Sent by TCP for agents, or over virtual links", ["process"]
        )
        self._drops = self._counter("drops", "What was dropped", ["process", "reason"])
        self._restarts = self._counter("process_restarts", "Starts after an end", ["process"])
        self._up = self._gauge("process_up", "Whether it is connected", ["role", "process"])

    def expect(self, entries: Iterable[ProcessEntry], elsewhere: Iterable[ProcessKey] = ()) -> None:
        """Shows processes as down until they connect; reserves labels for those elsewhere."""
        here = [self._who(entry.role.role, entry.id) for entry in entries]
        for role, process in here:
            self._up.labels(role, process).set(0)
            self._restarts.labels(process)
        self._expected.update(here, (self._who(*who) for who in elsewhere))
        for _, process in self._expected:
            self._region_of(process)

    def restarted(self, process: str) -> None:
        """Counts a process that was started again after its end."""
        name = self._processes.label(process)
        self._restarts.labels(name).inc()
        self._last_drops.pop(name, None)

    def lost(self, drops: Mapping[str, int]) -> None:
        """Sets the number of messages that the supervisor could not decode since its start."""
        self._count_drops(SUPERVISOR, drops)

    def take(self, item: Envelope | Presence) -> None:
        """Updates by a message of the world bus; other messages are ignored."""
        if isinstance(item, Presence):
            self._take_presence(item)
        elif isinstance(item.message, Progress):
            self._take_progress(item.message)
        elif isinstance(item.message, Metrics):
            self._take_metrics(item.message)

    def _take_presence(self, presence: Presence) -> None:
        who = role, process = self._who(presence.role, presence.id)
        if presence.alive or who in self._expected:
            self._up.labels(role, process).set(presence.alive)
            self._restarts.labels(process)
            self._present.add(who)
            return
        self._present.discard(who)
        self._up.remove_by_labels({"role": role, "process": process})
        if process not in {name for _, name in self._expected | self._present}:
            self._forget(process)

    def _forget(self, process: str) -> None:
        """Removes a process's labels, since any process may invent ids; counts of `other` stay."""
        if process == OTHER:
            return
        for metric in (self._uploaded, self._sent, self._drops, self._restarts):
            metric.remove_by_labels({"process": process})
        self._last_drops.pop(process, None)
        self._processes.release(process)

    def _take_progress(self, progress: Progress) -> None:
        if not self._progress:
            self._progress = {name: self._gauge(name, text) for name, text in _PROGRESS.items()}
            self._progress["progress_age_seconds"] = self._gauge(
                "progress_age_seconds", "Since these were received"
            )
            self._region_progress = {
                name: self._gauge(name, text, ["region"]) for name, text in _REGION_PROGRESS.items()
            }
            self._junction_progress = {
                name: self._gauge(name, text, ["tls", "region"])
                for name, text in _JUNCTION_PROGRESS.items()
            }
        values = {
            "frame": progress.frame,
            "simulated_time_seconds": progress.sim_time_ns / 1e9,
            "real_time_factor": progress.real_time_factor,
            "vehicles": progress.vehicles,
            "cavs": progress.cavs,
            "cvs": progress.cvs,
            "detections": progress.detections,
            "end_to_end_seconds": progress.end_to_end_ms / 1e3,
        }
        for name, value in values.items():
            self._progress[name].set(value)
        _set_age(self._progress["progress_age_seconds"], time.monotonic_ns())
        for region, of_region in progress.regions.items():
            self._take_region(self._regions.label(region), of_region)
        for tls, of_junction in progress.junctions.items():
            self._take_junction(self._signals.label(tls), of_junction)

    def _take_region(self, region: str, progress: RegionProgress) -> None:
        values = {
            "region_frames": progress.frames,
            "region_frames_incomplete": progress.incomplete,
            "region_agents": progress.agents,
            "region_detections": progress.detections,
            "region_uplink_mbps": progress.mbps,
            "region_end_to_end_seconds": progress.end_to_end_ms / 1e3,
        }
        for name, value in values.items():
            self._region_progress[name].labels(region).set(value)

    def _take_junction(self, tls: str, progress: JunctionProgress) -> None:
        region = self._regions.label(progress.region)
        values = {
            "junction_phase": progress.phase,
            "junction_vehicles": progress.vehicles,
            "junction_queued": progress.queued,
            "junction_coverage_ratio": math.nan if progress.coverage is None else progress.coverage,
            "signal_state_age_seconds": progress.unchanged_s,
        }
        for name, value in values.items():
            self._junction_progress[name].labels(tls, region).set(value)

    def _take_metrics(self, metrics: Metrics) -> None:
        process = self._processes.label(metrics.process)
        region = self._region_of(metrics.process)
        for span in metrics.spans:
            self._take_span(span, region)
        for upload in metrics.uploads:
            to_region = self._regions.label(upload.region)
            self._uploaded.labels(process, to_region).inc(upload.payload_bytes)
        if metrics.border_bytes:
            self._border.labels(region).inc(metrics.border_bytes)
        if metrics.wire:
            self._sent.labels(process).inc(sum(count.sent_bytes for count in metrics.wire))
        self._count_drops(process, metrics.drops)

    def _take_span(self, span: Span, region: str) -> None:
        took_ns = span.end_ns - span.start_ns
        if not 0 <= took_ns <= LONGEST_NS:
            self._odd_spans.inc()
            return
        self._stage.labels(self._stages.label(span.stage), region).observe(took_ns / 1e9)
        if span.stage == "world":
            self._frames.inc()
        elif span.stage == "actuate":
            age = self._request_age.labels(self._signals.label(span.agent))
            _set_age(age, time.monotonic_ns())

    def _count_drops(self, process: str, drops: Mapping[str, int]) -> None:
        """Adds what a process dropped since its last message; a fall means that it restarted.

        Under `other` several processes count: only a new highest count is known to be growth.
        """
        counts = Tally[str]()
        for reason, count in drops.items():
            counts[self._reasons.label(reason)] += count
        last = self._last_drops.setdefault(process, Tally())
        if process != OTHER and any(count < last[reason] for reason, count in counts.items()):
            last.clear()
        for reason, count in counts.items():
            self._drops.labels(process, reason).inc(max(0, count - last[reason]))
            last[reason] = max(count, last[reason])

    def _region_of(self, process: str) -> str:
        """Returns the label of the region that a process serves, empty if it serves no single."""
        region = region_of(process)
        return self._regions.label(region) if region else ""

    def _who(self, role: str, process: str) -> ProcessKey:
        return role if role in ROLES else OTHER, self._processes.label(process)

    def _counter(self, name: str, text: str, labels: Iterable[str] = ()) -> Counter:
        return Counter(f"cpnet_{name}", text, labels, registry=self.registry)

    def _gauge(self, name: str, text: str, labels: Iterable[str] = ()) -> Gauge:
        return Gauge(f"cpnet_{name}", text, labels, registry=self.registry)


def _set_age(gauge: Gauge, since_ns: int) -> None:
    gauge.set_function(lambda: (time.monotonic_ns() - since_ns) / 1e9)


@dataclass(frozen=True, slots=True)
class MetricsAddress:
    """Address at which the page is served."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    @classmethod
    def parse(cls, text: str) -> MetricsAddress:
        """Reads `PORT`, which means this machine alone, or `HOST:PORT`.

        Raises:
            ConfigError: it is neither, or the address is not available.
        """
        match = _ADDRESS.fullmatch(text)
        if match is None or not 1 <= int(match["port"]) <= 65535:
            raise ConfigError(
                f"--metrics {text!r}: needs PORT or HOST:PORT, with a port from 1 to 65535"
            )
        address = cls((match["host"] or "127.0.0.1").strip("[]"), int(match["port"]))
        try:
            found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
            with socket.socket(found[0][0]) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(found[0][4])
        except (OSError, UnicodeError) as error:
            raise address.unavailable(error) from None
        return address

    def unavailable(self, error: OSError | UnicodeError) -> ConfigError:
        """Returns the error with the reason why the address is not available."""
        why = (error.strerror if isinstance(error, OSError) else None) or error
        return ConfigError(f"--metrics: cannot listen at {self}: {why}; choose another port")


@contextmanager
def serving(address: MetricsAddress) -> Iterator[RunMetrics]:
    """Context manager: serves the metrics of a run.

    Raises:
        ConfigError: another process took the address.
    """
    metrics = RunMetrics()
    try:
        server, thread = start_http_server(address.port, address.host, metrics.registry)
    except OSError as error:
        raise address.unavailable(error) from None
    try:
        yield metrics
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
