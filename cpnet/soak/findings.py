"""What a soak found, and what of it is not as it must be."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from cpnet.soak.faults import Fault
from cpnet.soak.memory import Growth
from recorder.run import Run
from recorder.tables import GapRow
from studies.safety import violations_of

LIMIT_S = 3.0
FLAT_MIB = 32.0
FLAT_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Findings:
    """Faults with their recoveries, memory, and what the database says; gaps of the recorder."""

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
        asked: the frames of which somebody who listened all the time heard a request.
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
