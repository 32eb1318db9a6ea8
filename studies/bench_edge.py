"""`cpnet bench edge`: from payloads to counts, stage by stage, by detector and number of agents.

Recorded traffic, encoded beforehand; all scans of a frame are there at once, and are decoded as in
the edge's process, by a thread for each core. Every detector with every number of agents has a
process of its own, so that its memory is measured separately; they run one after the other.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from edge_server.config import EdgeConfig
from edge_server.decoding import DecoderPool, keep_freed_memory
from edge_server.frame import Frame
from edge_server.pipeline import Pipeline
from perception.config import DetectionConfig, DetectorName
from perception.registry import detector_of
from perception.roadway import Roadway
from protocol.errors import ConfigError
from protocol.messages import AgentPose, Scan, Truth
from protocol.regions import RegionMap
from sensing.config import SceneConfig
from sensing.recorded_scans import Recording
from sensing.terrain import Terrain
from sim_host.setup import build_setup
from studies.bench import JsonRow, empty_table, print_whole
from studies.bench_traffic import (
    RSU,
    SEED,
    agent_poses,
    record_traffic,
    rsu_pose,
    uploaded_scan,
)

TOTAL = "total"
MOST_AGENTS = 16
WARM_UP = 3  # frames: loops are read from their cache, buffers grow
STAGES = ("decode", "place", "check", "merge", "ground", "detect", "fuse", "track", "count", TOTAL)


@dataclass(frozen=True, slots=True)
class EdgeBench:
    """Parameters of the benchmark: `frames` frames of the same traffic for each case."""

    detectors: tuple[DetectorName, ...]
    agents: tuple[int, ...]
    frames: int

    @property
    def rows(self) -> int:
        """The number of rows."""
        return len(self.detectors) * len(self.agents) * len(STAGES)


@dataclass(frozen=True, slots=True)
class EdgeRow(JsonRow):
    """A stage of a detector for so many agents; `points` and `detections` are a frame's, means.

    `peak_mb` is the most memory of its process.
    `decode` and `place` are sums over threads that work at the same time, `total` is by the clock.
    """

    detector: str
    agents: int
    points: int
    detections: float
    stage: str
    ms_p50: float
    ms_p95: float
    peak_mb: float


def numbers_of(text: str) -> tuple[int, ...]:
    """Reads numbers of agents, written with commas.

    Raises:
        ConfigError: one is no number that can be measured, or stands twice.
    """
    words = text.split(",")
    numbers = tuple(int(word) for word in words if word.strip().isdecimal())
    if len(numbers) < len(words) or not all(1 <= n <= MOST_AGENTS for n in numbers):
        raise ConfigError(f"--agents {text}: must be numbers from 1 to {MOST_AGENTS}")
    if len(set(numbers)) < len(numbers):
        raise ConfigError(f"--agents {text}: each number may stand once")
    return numbers


def measure_edge(bench: EdgeBench) -> Iterator[EdgeRow]:
    """Yields the rows of each detector for each number of agents.

    Raises:
        ConfigError: a detector cannot be built.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name:
        traffic = Path(name)
        roadway = Roadway.of(build_setup({}, traffic).road_map, margin_m=0)
        for detector in bench.detectors:
            detector_of(DetectionConfig(detector=detector), roadway)
        record_traffic(traffic, max(bench.agents), bench.frames + WARM_UP)
        context = multiprocessing.get_context("spawn")
        for agents in bench.agents:
            for detector in bench.detectors:
                with context.Pool(1) as pool:
                    yield from pool.apply(_measure, (traffic, detector, agents))


def _measure(traffic: Path, detector: str, agents: int) -> list[EdgeRow]:
    """Measures one cell; runs in a process of its own."""
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as scratch:
        setup = build_setup({}, Path(scratch))
    road_map = setup.road_map
    config = EdgeConfig.model_validate({"detector": detector})
    pipeline = Pipeline.of(RegionMap.whole(road_map), config, seed=SEED)
    pool = DecoderPool(pipeline.open)
    recording = Recording(traffic)
    chosen = [RSU, *(name for name in recording.agents if name != RSU)][:agents]
    post = rsu_pose(road_map, Terrain(road_map, SceneConfig(), SEED))
    times_ms: dict[str, list[float]] = {stage: [] for stage in STAGES}
    points, detections = [], []
    frames = [
        (
            [uploaded_scan(recording, agent, truth, post) for agent in chosen],
            agent_poses(chosen, truth, setup),
            truth,
        )
        for truth in recording.truths
    ]
    for frame, (scans, poses, truth) in enumerate(frames):
        spent, seen, found = _run(pipeline, pool, scans, poses, truth)
        if frame >= WARM_UP:
            points.append(seen)
            detections.append(found)
            for stage in STAGES:
                times_ms[stage].append(spent.get(stage, 0.0))
    pool.close()
    peak_mb = _peak_mb()
    shape = (detector, agents, round(float(np.mean(points))), float(np.mean(detections)))
    rows = []
    for stage in STAGES:
        p50, p95 = np.percentile(times_ms[stage], [50, 95]).tolist()
        rows.append(EdgeRow(*shape, stage, p50, p95, peak_mb))
    return rows


def _peak_mb() -> float:
    """Returns the most memory that this process ever held.

    The kernel's resource usage (ru_maxrss) does not serve: a forked process inherits it.
    """
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def _run(
    pipeline: Pipeline,
    pool: DecoderPool,
    scans: list[Scan],
    poses: list[AgentPose],
    truth: Truth,
) -> tuple[dict[str, float], int, int]:
    """Returns the ms of each stage, those of threads summed; the points; the detections."""
    begin_ns = time.monotonic_ns()
    opened = [pending for scan in scans for pending in pool.put(scan, 0)] + list(pool.rest())
    chunks = [pending.chunk() for pending in opened]
    frame = Frame(
        truth.frame,
        truth.sim_time_ns,
        sorted(scan.agent for scan in scans),
        poses,
        chunks,
        complete=True,
        first_ns=0,
        ready_ns=0,
    )
    state = pipeline.run(frame)
    spent = {TOTAL: (time.monotonic_ns() - begin_ns) / 1e6}
    for span in [*(span for chunk in chunks for span in chunk.spans), *state.spans]:
        spent[span.stage] = spent.get(span.stage, 0.0) + (span.end_ns - span.start_ns) / 1e6
    return spent, state.points, len(state.detections.boxes)


_BESIDE = "reference"


def print_edge(rows: list[EdgeRow], console: Console) -> None:
    """Prints medians of all stages, then how many times as fast as `reference` each is."""
    stages = (stage for stage in STAGES if stage != TOTAL)
    table = empty_table(["detector", "agents", "points", *stages, "total", "p95", "MB", "x"])
    totals = {(row.detector, row.agents): row for row in rows if row.stage == TOTAL}
    for (detector, agents), total in totals.items():
        of_stage = {
            row.stage: row for row in rows if (row.detector, row.agents) == (detector, agents)
        }
        beside = totals.get((_BESIDE, agents))
        table.add_row(
            detector,
            str(agents),
            str(total.points),
            *(f"{of_stage[stage].ms_p50:.1f}" for stage in STAGES),
            f"{total.ms_p95:.1f}",
            f"{total.peak_mb:.0f}",
            f"{beside.ms_p50 / total.ms_p50:.1f}" if beside else "",
        )
    print_whole(table, console)
    console.print(
        "ms, medians of frames; decode and place are sums over threads, total is by the clock; "
        "MB: the most memory of its process; x: as fast as `reference`",
        style="dim",
    )
