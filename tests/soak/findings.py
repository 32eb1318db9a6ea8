"""Faults of a soak, what they led to, how memory grew, and the page about it."""

from __future__ import annotations

import json
import os
import signal
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from cpnet.supervisor import LIST_NAME
from protocol.errors import BusError
from recording.run import Run
from recording.tables import GapRow
from tests.signal_safety import violations_of

PAGE_MIB = 4096 / 2**20


@dataclass(frozen=True, slots=True)
class Growth:
    """Resident memory of a process in MiB: in the first and the last third of a soak, and most."""

    process: str
    early_mib: float
    late_mib: float
    most_mib: float


class Memory:
    """Samples the resident memory of all processes of a run."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._samples: dict[str, list[float]] = defaultdict(list)

    def sample(self) -> None:
        """Reads all processes once; one that is just being started again is left out."""
        for process, number in processes_of(self._run_dir).items():
            try:
                pages = int(Path(f"/proc/{number}/statm").read_text("ascii").split()[1])
            except (OSError, IndexError):
                continue
            self._samples[process].append(pages * PAGE_MIB)

    def growth(self) -> list[Growth]:
        """Returns how the memory of each process went, sorted by process."""
        return [_growth(name, samples) for name, samples in sorted(self._samples.items())]


def _growth(process: str, samples_mib: list[float]) -> Growth:
    third = max(1, len(samples_mib) // 3)
    early, late = median(samples_mib[:third]), median(samples_mib[-third:])
    return Growth(process, early, late, max(samples_mib))


SPARED = {"sim"}  # the world, which nothing can replace


@dataclass(frozen=True, slots=True)
class Fault:
    """A process that was killed, and how long it took until all was right; None if it never was."""

    victim: str
    frame: int
    recovery_s: float | None
    wrong: str = ""

    def __str__(self) -> str:
        took = f"right again after {self.recovery_s or 0:.2f} s"
        outcome = f"never right again ({self.wrong})" if self.recovery_s is None else took
        return f"{self.victim} at frame {self.frame}: {outcome}"


def processes_of(run_dir: Path) -> dict[str, int]:
    """Returns the process numbers of a run by id, as its supervisor has them now."""
    listed: dict[str, int] = json.loads((run_dir / LIST_NAME).read_text("utf-8"))
    return listed


def victims_of(processes: Sequence[str], kills: int, rng: np.random.Generator) -> list[str]:
    """Returns the processes to kill, in random order, each about as often."""
    candidates = sorted(set(processes) - SPARED)
    rounds = -(-kills // len(candidates))
    order = np.concatenate([rng.permutation(candidates) for _ in range(rounds)])
    return [str(name) for name in order[:kills]]


def kill(run_dir: Path, victim: str) -> None:
    """Kills a process without warning.

    Raises:
        BusError: it is gone already, and was not started again.
    """
    try:
        os.kill(processes_of(run_dir)[victim], signal.SIGKILL)
    except ProcessLookupError:
        raise BusError(f"{victim} is gone, and with it the run: see {run_dir}/logs") from None


LIMIT_S = 3.0
FLAT_MIB = 32.0
FLAT_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Findings:
    """Faults with their recoveries, memory, and figures of the database; gaps of the recorder."""

    minutes: float
    faults: list[Fault]
    memory: list[Growth]
    frames: int
    gaps: int
    unsafe: list[str]
    damage: list[str]

    def faults_found(self) -> list[str]:
        """Returns what is not as it must be, one sentence each."""
        late = [f for f in self.faults if f.recovery_s is None or f.recovery_s > LIMIT_S]
        grown = [g for g in self.memory if not is_flat(g)]
        return [
            *map(str, late),
            *(f"{g.process} grew from {g.early_mib:.0f} to {g.late_mib:.0f} MiB" for g in grown),
            *self.unsafe,
            *self.damage,
        ]


def is_flat(growth: Growth) -> bool:
    """Whether a process's memory stayed what it was, but for what any allocator keeps."""
    return growth.late_mib - growth.early_mib <= max(FLAT_MIB, FLAT_SHARE * growth.early_mib)


def look_back(
    run_dir: Path, minutes: float, faults: list[Fault], memory: list[Growth], asked: set[int]
) -> Findings:
    """Reads the run's database once the run is over.

    Args:
        run_dir: of the run.
        minutes: how long it was hurt.
        faults: who was killed.
        memory: of each process.
        asked: the frames with a request, by an observer that was attached all the time.
    """
    with Run(run_dir) as run:
        gaps = list(run.rows(GapRow))
        ((frames,),) = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")
        kept = {frame for (frame,) in run.query("SELECT frame FROM requests")}
        unsafe = violations_of(run)
        ((sound,),) = run.query("PRAGMA integrity_check")
    away = {n for gap in gaps for n in range(gap.after_frame, gap.until_frame + 1)}
    lost = sorted(asked - kept - away)
    deaths = sum(fault.victim == "record" for fault in faults)
    damage = [f"the database is damaged: {sound}"] if sound != "ok" else []
    if lost:
        damage.append(f"requests of {len(lost)} frames were lost outside of gaps, first {lost[0]}")
    own = sum(gap.away == "recorder" for gap in gaps)
    if own != deaths:
        damage.append(f"{own} gaps of the recorder are noted, it died {deaths} times")
    return Findings(minutes, faults, memory, frames, own, unsafe, damage)


def by_victim(faults: list[Fault]) -> list[tuple[str, int, float, float]]:
    """Returns by process how often it was killed, and median and longest recovery in s."""
    times: dict[str, list[float]] = defaultdict(list)
    for fault in faults:
        times[fault.victim].append(float("inf") if fault.recovery_s is None else fault.recovery_s)
    return [(name, len(took), median(took), max(took)) for name, took in sorted(times.items())]


def page(findings: Findings, command: str) -> str:
    """Returns a section with tables, and the command that made it."""
    within = sum(f.recovery_s is not None and f.recovery_s <= LIMIT_S for f in findings.faults)
    faults = findings.faults_found()
    lines = [
        f"`{command}`: {findings.minutes:.0f} minutes, {findings.frames} frames, "
        f"{len(findings.faults)} kills, {within} of them right again within {LIMIT_S:g} s.",
        "",
        "| killed | times | median | longest |",
        "|---|---|---|---|",
        *(
            f"| `{name}` | {times} | {mid:.2f} s | {most:.2f} s |"
            for name, times, mid, most in by_victim(findings.faults)
        ),
        "",
        "| resident memory in MiB | first third | last third | most |",
        "|---|---|---|---|",
        *(
            f"| `{g.process}` | {g.early_mib:.0f} | {g.late_mib:.0f} | {g.most_mib:.0f} |"
            for g in findings.memory
        ),
        "",
        f"Unsafe signal states: {len(findings.unsafe)}. The recorder died and noted "
        f"{findings.gaps} gaps; outside of them all requests that were heard are in the database: "
        f"{'yes' if not findings.damage else '; '.join(findings.damage)}.",
    ]
    if faults:
        lines += ["", "Not as it must be:", "", *(f"- {fault}" for fault in faults)]
    return "\n".join(lines) + "\n"
