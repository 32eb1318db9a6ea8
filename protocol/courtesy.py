"""How those who look on at a run leave the machine to those who take part in it."""

from __future__ import annotations

import math
import os

SAVED_NS = 200_000_000  # of a budget, at most, is kept for later


def step_back() -> None:
    """Lets all others go first, however urgent this process was when it was started.

    Who is merely less urgent still keeps a core for its slice of milliseconds from who wakes up
    meanwhile, which a frame that goes through many hands feels; the idle give it up at once.
    """
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


class Budget:
    """The time that a work may take which can be left out: a share of what passes.

    A core that is lent at once is still missing where another waits for its memory or its twin, so
    that giving way alone is not enough on a machine that the run fills.
    """

    def __init__(self, share: float, now_ns: int) -> None:
        """Begins with nothing.

        Args:
            share: of a core's time.
            now_ns: on any clock that goes on.
        """
        self._share = share
        self._since_ns = now_ns
        self._left_ns = 0.0

    @classmethod
    def of_this_machine(cls, share_per_core: float, now_ns: int) -> Budget:
        """Returns one that has this share of each core that this process may run on."""
        return cls(share_per_core * len(os.sched_getaffinity(0)), now_ns)

    @classmethod
    def endless(cls) -> Budget:
        """Returns one for a work that is in nobody's way."""
        return cls(1e9, 0)

    def has_some(self, now_ns: int) -> bool:
        """Whether there is time for one more."""
        gained_ns = (now_ns - self._since_ns) * self._share
        self._left_ns = min(self._left_ns + gained_ns, SAVED_NS)
        self._since_ns = now_ns
        return self._left_ns > 0

    def wait_s(self, now_ns: int) -> float:
        """Returns how long it will be until there is time for one more."""
        if self.has_some(now_ns):
            return 0.0
        return -self._left_ns / self._share / 1e9 if self._share > 0 else math.inf

    def spend(self, spent_ns: int) -> None:
        """Takes away what one has cost."""
        self._left_ns -= spent_ns
