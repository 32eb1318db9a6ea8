"""Hurts a run and measures how long it takes until all is right again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from cpnet.soak.faults import Fault, kill, processes_of, victims_of
from cpnet.soak.memory import Growth, Memory
from cpnet.soak.observer import Observer

GIVE_UP_S = 20.0
SAMPLE_S = 5.0


def hurt(
    observer: Observer,
    run_dir: Path,
    *,
    minutes: float,
    kills: int,
    rng: np.random.Generator,
    tell: Callable[[Fault], None],
) -> tuple[list[Fault], list[Growth]]:
    """Kills so many processes in so many minutes, at random times; returns what came of it.

    A process is killed once all is right; how long that stays so is drawn at random. Each fault is
    told at once.
    """
    memory = Memory(run_dir)
    faults = []
    began_ns = time.monotonic_ns()
    pause_s = minutes * 60 / kills
    for number, victim in enumerate(victims_of(list(processes_of(run_dir)), kills, rng)):
        due_ns = began_ns + round((number + rng.uniform(0, 0.5)) * pause_s * 1e9)
        for left_s in _slices(due_ns):
            observer.listen(left_s)
            memory.sample()
        observer.listen(GIVE_UP_S, observer.is_right)
        faults.append(hurt_once(observer, run_dir, victim))
        tell(faults[-1])
    return faults, memory.growth()


def hurt_once(
    observer: Observer, run_dir: Path, victim: str, patience_s: float = GIVE_UP_S
) -> Fault:
    """Kills a process and waits until all is right again, at most so long."""
    health = observer.health
    frame = health.frame
    since_ns = time.monotonic_ns()
    kill(run_dir, victim)
    observer.listen(patience_s, lambda: victim in health.absent())
    health.doubt()
    observer.listen(patience_s, observer.is_right)
    right_ns = health.right_since_ns
    if right_ns is None:
        return Fault(victim, frame, None, health.wrong)
    return Fault(victim, frame, (right_ns - since_ns) / 1e9)


def _slices(due_ns: int) -> Iterator[float]:
    while (left_ns := due_ns - time.monotonic_ns()) > 0:
        yield min(SAMPLE_S, left_ns / 1e9)
