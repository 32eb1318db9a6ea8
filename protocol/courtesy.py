"""How those who look on at a run leave the machine to those who take part in it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

LEFT_IDLE = 0.3  # of the cores' time
SPARE_TAKEN = 0.25  # of what they are idle beyond that; three works may have such a budget each
SPARE_EVERY_NS = 1_000_000_000
SAVED_NS = 200_000_000  # of a budget, at most, is kept for later


def step_back() -> None:
    """Lets all others go first, however urgent this process was when it was started.

    Who is merely less urgent still keeps a core for its slice of milliseconds from who wakes up
    meanwhile, which a frame that goes through many hands feels; the idle give it up at once.
    """
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def core_quota(cgroup: Path = Path("/sys/fs/cgroup")) -> float | None:
    """Returns how many cores a container may use, None if it may use all."""
    try:
        quota, period = (cgroup / "cpu.max").read_text("ascii").split()
    except (OSError, ValueError):
        return None
    return int(quota) / int(period) if quota.isdigit() else None


class Budget:
    """The time that a work may take which can be left out: a share of what passes.

    A core that is lent at once is still missing where another waits for its memory or its twin, so
    that giving way alone is not enough on a machine that the run fills.
    """

    def __init__(
        self, share: float, now_ns: int, spare: Callable[[int], float] = lambda _: 0.0
    ) -> None:
        """Begins with nothing.

        Args:
            share: of a core's time.
            now_ns: on any clock that goes on.
            spare: says, at a time, what more of a core's time nobody needs.
        """
        self._share = share
        self._spare = spare
        self._since_ns = now_ns
        self._left_ns = 0.0

    @classmethod
    def of_this_machine(cls, share_per_core: float, now_ns: int) -> Budget:
        """Returns one that has this share of each core that this process may run on.

        Where they are often idle, it has a part of that time as well.
        """
        cores = os.sched_getaffinity(0)
        if (quota := core_quota()) is not None:  # then nobody knows of how much is idle
            return cls(share_per_core * min(len(cores), quota), now_ns)
        return cls(share_per_core * len(cores), now_ns, Spare(cores))

    @classmethod
    def endless(cls) -> Budget:
        """Returns one for a work that is in nobody's way."""
        return cls(1e9, 0)

    def has_some(self, now_ns: int) -> bool:
        """Whether there is time for one more."""
        gained_ns = (now_ns - self._since_ns) * (self._share + self._spare(now_ns))
        self._left_ns = min(self._left_ns + gained_ns, SAVED_NS)
        self._since_ns = now_ns
        return self._left_ns > 0

    def wait_s(self, now_ns: int) -> float:
        """Returns how long it will be until there is time for one more."""
        if self.has_some(now_ns):
            return 0.0
        share = self._share + self._spare(now_ns)
        return -self._left_ns / share / 1e9 if share > 0 else math.inf

    def spend(self, spent_ns: int) -> None:
        """Takes away what one has cost."""
        self._left_ns -= spent_ns


class Spare:
    """The time of cores that nobody needs: a part of what they are idle, above what is left free.

    Who has to wait for a core finds one at once as long as some are idle.
    """

    def __init__(self, cores: set[int], stat: Path = Path("/proc/stat")) -> None:
        """Begins to watch these cores; `stat` is the kernel's account of their time."""
        self._names = {f"cpu{core}" for core in cores}
        self._stat = stat
        self._read_ns = 0
        self._account = (0, 0)
        self._share = 0.0

    def __call__(self, now_ns: int) -> float:
        """Returns what share of one core's time there is to spare, as it was lately."""
        if now_ns - self._read_ns >= SPARE_EVERY_NS:
            idle, passed = self._read()
            was_idle, had_passed = self._account
            if self._read_ns and passed > had_passed:
                left = (idle - was_idle) / (passed - had_passed) - LEFT_IDLE
                self._share = max(left, 0.0) * SPARE_TAKEN * len(self._names)
            self._read_ns, self._account = now_ns, (idle, passed)
        return self._share

    def _read(self) -> tuple[int, int]:
        """Returns how long the cores were idle and how long they were there; 0 if nobody knows."""
        idle = passed = 0
        try:
            lines = self._stat.read_text("ascii").splitlines()
        except OSError:
            return 0, 0
        for name, *fields in map(str.split, lines):
            if name in self._names:
                ticks = [int(field) for field in fields[:8]]
                idle += ticks[3]
                passed += sum(ticks)
        return idle, passed
