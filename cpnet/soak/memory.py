"""How much memory each process of a run takes, over time."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from cpnet.soak.faults import processes_of

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
