"""Benchmark of the recorder: bytes a simulated hour, frames a second, CPU time, for a city.

The record role receives, frame after frame, the bytes that a city's processes would publish; it
decodes, checks, aggregates and writes them as in a run. Making the messages is not measured. No
scans are kept, `record.snapshot_period_s=0`: what snapshots take follows from their period.
"""

from __future__ import annotations

import gc
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from protocol import messages as m
from protocol.errors import ConfigError
from protocol.in_process import InProcessBus, InProcessRouter
from protocol.inbox import Inbox
from protocol.limits import MAX_BATCH
from protocol.process import Context, collect_seldom, deliver
from protocol.roadmap import Intersection, RoadMap, Signal
from protocol.topics import BusName
from recording.role import RecordRole
from recording.run import Run
from studies.bench import JsonRow, empty_table, print_whole

PERIOD_S = 1.0
VEHICLES, LANES = 15, 8  # of a junction; as many lanes lead to it as away
SEEN = 28  # vehicles on which points of an agent's scan lie: those of `grid` at 80 % of saturation
STAGES = ("sense", "select", "encode", "send")
EDGE_STAGES = ("wait", "check", "merge", "ground", "detect", "fuse", "border", "track", "count")
MS = 1_000_000


@dataclass(frozen=True, slots=True)
class RecorderBench:
    """A city of so many junctions in so many regions, each with so many agents."""

    junctions: int = 200
    regions: int = 50
    agents: int = 5
    frames: int = 120

    def check(self) -> None:
        """Raises ConfigError if there is no such city."""
        if not 1 <= self.regions <= self.junctions:
            raise ConfigError(f"--regions {self.regions}: allowed are 1 to {self.junctions}")

    @property
    def by_region(self) -> dict[str, list[str]]:
        """The signals of each region."""
        cuts = np.array_split(np.arange(self.junctions), self.regions)
        return {f"r{i}": [f"J{n}" for n in cut.tolist()] for i, cut in enumerate(cuts)}


@dataclass(frozen=True, slots=True)
class RecorderRow(JsonRow):
    """Cost of recording.

    Attributes:
        gb_per_hour: of the database, for a simulated hour; `gb_by_table` are its parts.
        frames_per_s: that the recorder takes, by the wall clock, while nothing else runs.
        core_ms: CPU time of a frame.
    """

    junctions: int
    regions: int
    agents: int
    vehicles: int
    frames: int
    gb_per_hour: float
    gb_by_table: dict[str, float]
    frames_per_s: float
    core_ms: float
    drops: int


def measure_recorder(bench: RecorderBench) -> RecorderRow:
    """Records a city and measures it.

    Raises:
        ConfigError: there is no such city.
    """
    bench.check()
    with _collector_of_a_process(), tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name:
        recorder = _Recorder(bench, Path(name))
        for frame in range(bench.frames):
            recorder.take(frame)
        recorder.close()
        with Run(Path(name)) as run:
            sizes = dict(run.query("SELECT name, sum(pgsize) FROM dbstat GROUP BY name"))
    by_table = {
        name: size_bytes * 3600 / PERIOD_S / bench.frames / 1e9
        for name, size_bytes in sorted(sizes.items(), key=lambda item: -item[1])
    }
    return RecorderRow(
        junctions=bench.junctions,
        regions=bench.regions,
        agents=bench.regions * bench.agents,
        vehicles=bench.junctions * VEHICLES,
        frames=bench.frames,
        gb_per_hour=sum(by_table.values()),
        gb_by_table=by_table,
        frames_per_s=bench.frames / recorder.wall_s,
        core_ms=1e3 * recorder.cpu_s / bench.frames,
        drops=sum(recorder.inbox.drops.values()),
    )


@contextmanager
def _collector_of_a_process() -> Iterator[None]:
    """Sets Python's garbage collector as in a recorder that was forked off the fork server."""
    usual = gc.get_threshold()
    gc.freeze()
    collect_seldom()
    try:
        yield
    finally:
        gc.set_threshold(*usual)
        gc.unfreeze()


def print_recorder(rows: list[RecorderRow], console: Console) -> None:
    """Prints the cost, and the largest tables."""
    for row in rows:
        console.print(
            f"{row.junctions} junctions, {row.regions} regions, {row.agents} agents, "
            f"{row.vehicles} vehicles, {row.frames} frames, {row.drops} drops\n"
            f"{row.frames_per_s:.1f} frames/s, {row.core_ms:.0f} core-ms a frame, "
            f"{row.gb_per_hour:.2f} GB a simulated hour"
        )
        table = empty_table(("table", "GB/h"))
        for name, gigabytes in list(row.gb_by_table.items())[:8]:
            table.add_row(name, f"{gigabytes:.2f}")
        print_whole(table, console)


class _Recorder:
    """The record role, and in-process buses that deliver a city's messages to it."""

    def __init__(self, bench: RecorderBench, folder: Path) -> None:
        self.inbox, stop = Inbox(), threading.Event()
        world, v2x = InProcessRouter(BusName.WORLD), InProcessRouter()
        self._world, self._v2x = world.bus(self.inbox), v2x.bus(self.inbox)
        self._city = _City(bench)
        self._role = RecordRole.build(
            Context(
                "record", self._city.setup(), folder, self._world, self._v2x,
                self.inbox, stop, lambda: v2x.bus(self.inbox),
            )
        )  # fmt: skip
        self.wall_s = self.cpu_s = 0.0

    def take(self, frame: int) -> None:
        """Delivers all messages of a frame, as the loop of its process would."""
        for topic, message, parts in self._city.messages(frame):
            bus: InProcessBus = self._v2x if topic in _V2X else self._world
            bus.publish(topic, message, **parts)
        self._timed(self._drain)

    def close(self) -> None:
        """Writes the rest."""
        self._timed(self._role.close)

    def _drain(self) -> None:
        taken = 0
        while (item := self.inbox.get()) is not None:
            deliver(self._role, self.inbox, item)
            taken += 1
            if taken % MAX_BATCH == 0:
                self._role.poll()
        self._role.poll()

    def _timed(self, work: Callable[[], None]) -> None:
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        work()
        self.wall_s += time.perf_counter() - wall_s
        self.cpu_s += time.process_time() - cpu_s


_V2X = ("state", "request", "detections", "lanes")
_Published = tuple[str, m.Message, dict[str, str]]


class _City:
    """Messages of the processes of a city in a frame; vehicles drive, counts are constant."""

    def __init__(self, bench: RecorderBench) -> None:
        self._bench = bench
        self._regions = bench.by_region
        self._random = np.random.default_rng(1)
        number = bench.junctions * VEHICLES
        self._vehicles = [f"J{n // VEHICLES}_in-to-J{n % 97}_out.{n}" for n in range(number)]
        self._lanes = [f"J{n // VEHICLES}_in_{n % LANES}" for n in range(number)]
        self._poses = self._random.uniform(-200, 200, (number, 6))
        self._poses[:, 3:] /= 1000

    def setup(self) -> m.Setup:
        """Returns the setup of the city."""
        signals = [Signal(tls=t, links=[], conflicts=[], plan=[]) for t in self._listed()]
        places = [Intersection(signal=s, centre=(0, 0, 0), outline=[]) for s in signals]
        return m.Setup(
            scenario={
                "mode": "lockstep", "frame_period_s": PERIOD_S,
                "record": {"snapshot_period_s": 0}, "regions": self._regions,
            },
            road_map=RoadMap(name="city", lanes=[], intersections=places),
            vehicle_types=[], meshes=[],
            mesh_vertices=np.zeros((0, 3)), mesh_triangles=np.zeros((0, 3)),
        )  # fmt: skip

    def _listed(self) -> Iterable[str]:
        return (tls for signals in self._regions.values() for tls in signals)

    def messages(self, frame: int) -> Iterator[_Published]:
        """Yields the messages of a frame."""
        when = {"frame": frame, "sim_time_ns": round(frame * PERIOD_S * 1e9)}
        self._poses[:, :2] += self._random.uniform(-10, 10, (len(self._poses), 2))
        yield from self._world(when)
        for region, signals in self._regions.items():
            yield from self._region(when, region, signals)
        acts = [_span("actuate", tls, 80) for tls in self._listed()]
        yield _metrics(when, "sim", spans=[*acts, _span("world", "", 0)])

    def _agents(self, region: str) -> list[str]:
        return [f"agent-{region}-{n}" for n in range(self._bench.agents)]

    def _world(self, when: dict[str, int]) -> Iterator[_Published]:
        number = len(self._vehicles)
        agents = [agent for region in self._regions for agent in self._agents(region)]
        tick = m.Tick(
            **when, processes=["vehicle-0"], bodies=number, agents=agents,
            equipment=np.full(len(agents), m.Equipment.CAV), hosts=np.zeros(len(agents)),
            places=np.zeros((len(agents), 2)), tiles=np.zeros((0, 2)), since=np.zeros(0),
        )  # fmt: skip
        truth = m.Truth(
            **when, ids=self._vehicles, types=["car"] * number, lanes=self._lanes,
            poses=self._poses, speeds_mps=self._poses[:, 0] / 20,
            lane_positions_m=self._poses[:, 1], equipment=np.zeros(number),
        )  # fmt: skip
        yield "tick", tick, {}
        yield "truth", truth, {}

    def _region(
        self, when: dict[str, int], region: str, signals: list[str]
    ) -> Iterator[_Published]:
        agents = self._agents(region)
        yield from self._uploads(when, region, agents, signals)
        yield "detections", self._detections(when, agents, signals), {"region": region}
        for tls in signals:
            counts = {f"{tls}_in_{n}": n for n in range(LANES)}
            lanes = m.LaneCounts(
                **when, tls=tls, agents=agents, complete=True, upstream=counts, downstream=counts,
                stationary_upstream=counts, stationary_downstream=counts,
                coasted_upstream=counts, coasted_downstream=counts,
                coverage_upstream=dict.fromkeys(counts, 0.9),
                coverage_downstream=dict.fromkeys(counts, 0.9),
            )  # fmt: skip
            request = m.SignalRequest(
                **when, tls=tls, state="rrrrGGGG", policy="max_pressure", pressures=[29.9, 4.1]
            )
            state = m.SignalState(
                **when, tls=tls, state="rrrrGGGG", stage="green", green="rrrrGGGG",
                source="max_pressure", earliest_change_ns=0,
            )  # fmt: skip
            yield "lanes", lanes, {"region": region, "tls": tls}
            yield "request", request, {"tls": tls}
            yield "state", state, {"tls": tls}

    def _detections(
        self, when: dict[str, int], agents: list[str], signals: list[str]
    ) -> m.Detections:
        rows = [n for tls in signals for n in self._near(tls)]
        return m.Detections(
            **when, agents=agents, boxes=np.c_[self._poses[rows], np.ones(len(rows))],
            scores=self._random.random(len(rows)), classes=np.zeros(len(rows), np.uint8),
            lanes=[self._lanes[n] for n in rows],
            distances_m=self._poses[rows, 0], sources=["lidar"] * len(rows),
            track_ids=1 + np.array(rows), speeds_mps=self._poses[rows, 0] / 20,
            coasted_s=np.zeros(len(rows)), ages_s=np.ones(len(rows)),
            position_std_m=np.full(len(rows), 0.25), speed_std_mps=np.full(len(rows), 0.25),
        )  # fmt: skip

    def _near(self, tls: str) -> range:
        first = int(tls[1:]) * VEHICLES
        return range(first, first + VEHICLES)

    def _uploads(
        self, when: dict[str, int], region: str, agents: list[str], signals: list[str]
    ) -> Iterator[_Published]:
        for number, agent in enumerate(agents):
            first = self._near(signals[number % len(signals)]).start
            count = len(self._vehicles)
            seen = [self._vehicles[(first + n) % count] for n in range(min(SEEN, count))]
            points = self._random.integers(1, 4000, len(seen))
            sighting = m.Sighting(frame=when["frame"], agent=agent, vehicles=seen, points=points)
            yield "sighting", sighting, {"agent": agent}
        sent = [_upload(agent, region) for agent in agents]
        wire = [m.WireCount(agent=a, frame=when["frame"], sent_bytes=31_000) for a in agents]
        spans = [_span(stage, a, n) for a in agents for n, stage in enumerate(STAGES)]
        yield _metrics(when, f"infra-{region}", spans=spans, uploads=sent, wire=wire)
        opened = [_span(stage, a, 13 + n) for a in agents for n, stage in enumerate(_OPENED)]
        spans = opened + [_span(stage, "", 20 + n) for n, stage in enumerate(EDGE_STAGES)]
        came = [
            m.Arrival(agent=a, chunk=0, received_ns=12 * MS, decoded_ns=13 * MS) for a in agents
        ]
        yield _metrics(when, f"edge-{region}", spans=spans, arrivals=came, points=90_000)
        spans = [_span("decide", tls, 40) for tls in signals]
        yield _metrics(when, f"signal-{region}", spans=spans)


_OPENED = ("decode", "place")


def _span(stage: str, agent: str, start_ms: int) -> m.Span:
    return m.Span(stage=stage, agent=agent, start_ns=start_ms * MS, end_ns=(start_ms + 1) * MS)


def _upload(agent: str, region: str) -> m.Upload:
    return m.Upload(
        agent=agent, region=region, chunk=0, points=90_000, payload_bytes=30_000,
        sense_start_ns=0, sense_end_ns=9 * MS, encode_end_ns=10 * MS, sent_ns=11 * MS,
    )  # fmt: skip


def _metrics(when: dict[str, int], process: str, **parts: Any) -> _Published:  # noqa: ANN401
    return "metrics", m.Metrics(process=process, **when, **parts), {"process": process}
