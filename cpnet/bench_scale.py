"""`cpnet bench scale`: CPU time of a frame of an agent, over all processes, by size of the city.

Each case is `cpnet up grid` in lockstep with all its processes; the CPU time of each is read from
the operating system while the run goes on, so that starting and warming up do not count.
"""

from __future__ import annotations

import io
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import ceil, isqrt
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.console import Console

from cpnet.preparation import Options
from cpnet.scenario import load
from cpnet.supervisor import LIST_NAME
from cpnet.up import up
from protocol.errors import ConfigError
from protocol.instances import role_of
from recording.latency_breakdown import EDGE_STAGES
from recording.run import Run
from recording.tables import FrameRow, LatencyRow
from studies.bench import JsonRow, empty_table, print_whole
from studies.in_process import run_in_process

JUNCTIONS_PER_REGION = 25
WARM_FRAMES = 10  # agents connect, compiled code is read, buffers grow
CITY_CAVS = 1000
_SAMPLE_S = 0.25
_SELF = "supervisor"


@dataclass(frozen=True, slots=True)
class ScaleBench:
    """Parameters of the benchmark: square numbers of junctions, each with a post; duration."""

    junctions: tuple[int, ...]
    duration_s: float
    cav_rate: float

    @classmethod
    def of(cls, junctions: str, duration_s: float, cav_rate: float) -> ScaleBench:
        """Reads numbers of junctions, written with commas.

        Raises:
            ConfigError: one is no number.
        """
        try:
            return cls(tuple(int(word) for word in junctions.split(",")), duration_s, cav_rate)
        except ValueError:
            raise ConfigError(f"--junctions {junctions}: must be numbers with commas") from None

    def check(self) -> None:
        """Raises ConfigError if it cannot be measured."""
        for number in self.junctions:
            if number < 1 or isqrt(number) ** 2 != number or number > 676:
                raise ConfigError(f"--junctions {number}: must be a square, 1 to 676")
        if self.duration_s < 2 * WARM_FRAMES:
            raise ConfigError(f"--duration {self.duration_s:g}: must be {2 * WARM_FRAMES} or more")

    def overrides(self, junctions: int) -> dict[str, Any]:
        """Returns the scenario keys of a grid of so many junctions."""
        return {
            "traffic.grid_size": isqrt(junctions),
            "traffic.cav_rate": self.cav_rate,
            "regions": ceil(junctions / JUNCTIONS_PER_REGION),
            "duration_s": self.duration_s,
            "record.snapshot_period_s": 0,
        }


@dataclass(frozen=True, slots=True)
class ScaleRow(JsonRow):
    """One size of the city.

    Attributes:
        agents: CAVs and posts that scan, on average of the frames that count.
        cavs: of these, CAVs.
        core_ms: CPU time of all processes for a frame of an agent.
        core_ms_by_role: its parts.
        parts_ms: casting, encoding and the edge's stages for a frame of an agent, by the clock of a
            run in one process, where nothing else delays them; None where that was not run.
        agent_mb: memory that a vehicle process holds beyond that before its first frame, for each
            of its agents.
    """

    junctions: int
    regions: int
    frames: int
    agents: float
    cavs: float
    real_time_factor: float
    core_ms: float
    core_ms_by_role: dict[str, float]
    parts_ms: dict[str, float] | None
    agent_mb: float


def measure_scale(bench: ScaleBench) -> Iterator[ScaleRow]:
    """Yields a row for each size, the first with the cost of its parts.

    Raises:
        ConfigError: what is asked for cannot be measured, or a run failed.
    """
    bench.check()
    with tempfile.TemporaryDirectory(prefix="cpnet-bench-") as name:
        for index, junctions in enumerate(bench.junctions):
            folder = Path(name) / f"{junctions}"
            parts = _parts_ms(bench, junctions, Path(name) / "parts") if index == 0 else None
            yield _measured(bench, junctions, folder, parts)


def _measured(
    bench: ScaleBench, junctions: int, folder: Path, parts: dict[str, float] | None
) -> ScaleRow:
    output = io.StringIO()
    options = Options("grid", bench.overrides(junctions), None, [], [], folder)
    with ProcessMeter(folder / LIST_NAME) as meter:
        status, _ = up(options, Console(file=output))
    if status > 128:  # a signal asked for the end
        raise SystemExit(status)
    if status != 0:
        raise ConfigError(f"the run with {junctions} junctions failed:\n{output.getvalue()}")
    with Run(folder) as run:
        return _row(bench, junctions, [*run.rows(FrameRow)], meter, parts)


def _row(
    bench: ScaleBench,
    junctions: int,
    frames: list[FrameRow],
    meter: ProcessMeter,
    parts: dict[str, float] | None,
) -> ScaleRow:
    began_ns = [row.tick_ns for row in frames if row.tick_ns is not None]
    begin_ns, end_ns = began_ns[WARM_FRAMES], began_ns[-1]  # ends as the last frame begins
    frames = frames[WARM_FRAMES:-1]
    counted = len(frames)
    agents = float(np.mean([row.agents or 0 for row in frames]))
    cpu_s = meter.cpu_s(begin_ns, end_ns)
    by_role: dict[str, float] = {}
    for name, seconds in cpu_s.items():
        role = name if name == _SELF else role_of(name)
        by_role[role] = by_role.get(role, 0.0) + 1e3 * seconds / (counted * agents)
    cavs = float(np.mean([row.cavs or 0 for row in frames]))
    return ScaleRow(
        junctions=junctions,
        regions=bench.overrides(junctions)["regions"],
        frames=counted,
        agents=agents,
        cavs=cavs,
        real_time_factor=counted * 1e9 / (end_ns - begin_ns),
        core_ms=sum(by_role.values()),
        core_ms_by_role=by_role,
        parts_ms=parts,
        agent_mb=meter.growth_mb(began_ns[0]) / max(cavs, 1.0),
    )


class ProcessMeter:
    """Reads CPU time and memory of a run's processes, a few times a second, while it is entered."""

    def __init__(self, listing: Path) -> None:
        """Takes the file in which the supervisor lists the processes."""
        self._listing = listing
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._cpu: dict[str, list[tuple[int, float]]] = {}
        self._memory: dict[str, list[tuple[int, int]]] = {}

    def __enter__(self) -> ProcessMeter:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def cpu_s(self, begin_ns: int, end_ns: int) -> dict[str, float]:
        """Returns each process's CPU time between two monotonic times, in s."""
        found = {}
        for name, seen in self._cpu.items():
            at_ns, cpu_s = (list(column) for column in zip(*seen, strict=True))
            begin_s, end_s = np.interp([begin_ns, end_ns], at_ns, cpu_s)
            found[name] = float(end_s - begin_s)
        return found

    def growth_mb(self, since_ns: int) -> float:
        """Returns by how many MB all vehicle processes have grown since a monotonic time."""
        grown = 0.0
        for seen in self._memory.values():
            before = [size for at_ns, size in seen if at_ns <= since_ns]
            grown += max(size for _, size in seen) - (before[-1] if before else 0)
        return grown / 1e6

    def _watch(self) -> None:
        processes = {_SELF: psutil.Process()}
        while not self._over.wait(_SAMPLE_S):
            if len(processes) == 1 and self._listing.is_file():
                listed = json.loads(self._listing.read_text())
                processes |= {name: psutil.Process(number) for name, number in listed.items()}
            for name, process in processes.items():
                with suppress(psutil.Error):  # it has ended
                    self._read(name, process)

    def _read(self, name: str, process: psutil.Process) -> None:
        times, now_ns = process.cpu_times(), time.monotonic_ns()
        own_s = time.thread_time() if name == _SELF else 0.0  # of this thread, which measures
        self._cpu.setdefault(name, []).append((now_ns, times.user + times.system - own_s))
        if role_of(name) == "vehicle":
            size = process.memory_full_info().uss
            self._memory.setdefault(name, []).append((now_ns, size))


_EDGE_STAGES_BY_AGENT = ("decode", "place")


def _parts_ms(bench: ScaleBench, junctions: int, folder: Path) -> dict[str, float]:
    """Returns the time of casting, encoding and the edge for a frame of an agent."""
    folder.mkdir()
    run_in_process(load("grid", bench.overrides(junctions)).model_dump(mode="json"), folder)
    with Run(folder) as run:
        rows = [row for row in run.rows(LatencyRow) if row.frame >= WARM_FRAMES]
    own = {stage: sum(getattr(row, f"{stage}_ns") for row in rows) for stage in ("sense", "encode")}
    shared = {(row.frame, row.region): row for row in rows}.values()
    edge = sum(getattr(row, f"{stage}_ns") for row in rows for stage in _EDGE_STAGES_BY_AGENT)
    edge += sum(getattr(row, f"{stage}_ns") for row in shared for stage in EDGE_STAGES)
    return {
        name: total / len(rows) / 1e6
        for name, total in (("cast", own["sense"]), ("encode", own["encode"]), ("edge", edge))
    }


def print_scale(rows: list[ScaleRow], console: Console) -> None:
    """Prints a line for each size, a comparison, and an extrapolation to a large city."""
    roles = list(dict.fromkeys(role for row in rows for role in row.core_ms_by_role))
    heads = ["junctions", "regions", "agents", "CAVs", "frames", "x real time", "core-ms", "ratio"]
    table = empty_table([*heads, *roles, "MB a CAV"])
    for row in rows:
        table.add_row(
            *(str(row.junctions), str(row.regions), f"{row.agents:.1f}", f"{row.cavs:.1f}"),
            *(str(row.frames), f"{row.real_time_factor:.2f}", f"{row.core_ms:.2f}"),
            f"{row.core_ms / rows[0].core_ms:.2f}",
            *(f"{row.core_ms_by_role.get(role, 0.0):.2f}" for role in roles),
            f"{row.agent_mb:.1f}",
        )
    print_whole(table, console)
    console.print(
        "core-ms: CPU time of all processes for a frame of an agent (CAV or post), by role beside "
        f"it; ratio: to {rows[0].junctions} junctions; MB a CAV: beyond its process's own",
        style="dim",
    )
    parts = rows[0].parts_ms
    if parts is not None:
        total = sum(parts.values())
        listed = ", ".join(f"{name} {value:.2f}" for name, value in parts.items())
        console.print(
            f"{rows[0].junctions} junctions in one process, by the clock: {listed}, together "
            f"{total:.2f} ms; all in all {rows[0].core_ms / total:.2f} times that"
        )
    last = rows[-1]
    cores = last.core_ms / 1e3 * last.agents / max(last.cavs, 1.0) * CITY_CAVS
    console.print(
        f"extrapolated, not measured: {CITY_CAVS} CAVs at 1 Hz and as many posts beside each as "
        f"with {last.junctions} junctions would keep {cores:.0f} cores busy"
    )
