"""A tally as Prometheus' families of samples."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from cpnet.exporter.counts import BUCKETS_S, Histogram
from cpnet.exporter.tally import Glimpse, Tally
from protocol.version import own_version

_BOUNDS = (*map(str, BUCKETS_S), "+Inf")


class TallyCollector(Collector):
    """Reads the tally whenever a page is asked for."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally

    def collect(self) -> Iterable[Metric]:
        """Returns all families as they are now."""
        with self._tally.lock:
            return families(self._tally, time.monotonic_ns())


def families(tally: Tally, now_ns: int) -> list[Metric]:
    """Returns all that is known; what nobody has told yet has no sample."""
    drops = {
        (process, reason): count
        for process, rising in tally.drops.items()
        for reason, count in rising.total.items()
    }
    restarts = dict.fromkeys((process for _, process in tally.present), 0) | tally.restarts
    by_process = ("process",)
    acted = [] if tally.acted_ns is None else [((), (now_ns - tally.acted_ns) / 1e9)]
    present = {who: float(alive) for who, alive in tally.present.items()}
    return [
        _gauge("build_info", "The cpnet that exports this", [((own_version(),), 1)], ("version",)),
        _counter("frames", "Frames that the world has finished", [((), tally.frames)]),
        *_glimpses(tally.glimpse, now_ns),
        _gauge("signal_request_age_seconds", "Since a request last reached the signal", acted),
        _stages(tally.stages),
        _counter("odd_spans", "Stages left out: their times cannot be", [((), tally.odd_spans)]),
        _counter("uploaded_bytes", "Payload of scans", _one(tally.uploaded_bytes), by_process),
        _counter(
            "sent_bytes", "Sent by TCP for agents, or over virtual links",
            _one(tally.sent_bytes), by_process,
        ),
        _counter("drops", "What was dropped", drops.items(), ("process", "reason")),
        _gauge("process_up", "Whether it shows itself", present.items(), ("role", "process")),
        _counter("process_restarts", "Starts after an end", _one(restarts), by_process),
    ]  # fmt: skip


def _glimpses(glimpse: Glimpse | None, now_ns: int) -> list[Metric]:
    if glimpse is None:
        return []
    progress = glimpse.progress
    rows = (
        ("frame", "Newest frame", progress.frame),
        ("simulated_time_seconds", "Time of that frame", progress.sim_time_ns / 1e9),
        ("real_time_factor", "Simulated over real time", progress.real_time_factor),
        ("vehicles", "Vehicles present", progress.vehicles),
        ("cavs", "Of these, with a LiDAR", progress.cavs),
        ("cvs", "Of these, with a radio alone", progress.cvs),
        ("detections", "Vehicles found in the newest frame", progress.detections),
        ("end_to_end_seconds", "Newest, from sensing to signal", progress.end_to_end_ms / 1e3),
        ("signal_state_age_seconds", "Simulated, of what it shows", glimpse.state_age_ns / 1e9),
        ("progress_age_seconds", "Since these were told", (now_ns - glimpse.heard_ns) / 1e9),
    )
    return [_gauge(name, text, [((), value)]) for name, text, value in rows]


def _gauge(
    name: str,
    text: str,
    samples: Iterable[tuple[tuple[str, ...], float]],
    labels: tuple[str, ...] = (),
) -> Metric:
    family = GaugeMetricFamily(f"cpnet_{name}", text, labels=labels)
    for values, value in samples:
        family.add_metric(values, value)
    return family


def _counter(
    name: str,
    text: str,
    samples: Iterable[tuple[tuple[str, ...], float]],
    labels: tuple[str, ...] = (),
) -> Metric:
    family = CounterMetricFamily(f"cpnet_{name}", text, labels=labels)
    for values, count in samples:
        family.add_metric(values, count)
    return family


def _one(counts: Mapping[str, int]) -> Iterable[tuple[tuple[str, ...], float]]:
    return [((name,), count) for name, count in counts.items()]


def _stages(stages: Mapping[str, Histogram]) -> Metric:
    family = HistogramMetricFamily("cpnet_stage_seconds", "Time of a stage", labels=("stage",))
    for stage, histogram in stages.items():
        reached, buckets = 0, []
        for bound, count in zip(_BOUNDS, histogram.counts, strict=True):
            reached += count
            buckets.append((bound, float(reached)))
        family.add_metric((stage,), buckets, histogram.sum_ns / 1e9)
    return family
