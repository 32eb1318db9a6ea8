"""Faults: which process is killed next, and how."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cpnet.supervisor import LIST_NAME
from protocol.errors import BusError

SPARED = {"sim"}  # the world; what it is to others, nothing can stand in for


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
    """Returns whom to kill, in random order, everybody about as often."""
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
