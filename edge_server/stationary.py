"""Stationary vehicles: those at whose place one was detected a moment ago as well."""

from __future__ import annotations

from collections import deque

import numpy as np

from perception.arrays import Bools, Floats

LOOK_BACK_NS = 900_000_000  # long enough that a box's jitter is no motion
FORGET_NS = 2_100_000_000
JITTER_M = 0.3


class StationaryVehicles:
    """Remembers where vehicles were; frames come in the order of their time."""

    def __init__(self, below_mps: float) -> None:
        self._below_mps = below_mps
        self._past: deque[tuple[int, Floats]] = deque()

    def mark(self, sim_time_ns: int, places_m: Floats) -> Bools:
        """Marks those of the places (N, 2) whose vehicle is slower than the limit.

        A vehicle that was not detected before is not stationary.
        """
        while self._past and not 0 < sim_time_ns - self._past[0][0] <= FORGET_NS:
            self._past.popleft()
        old = [past for past in self._past if sim_time_ns - past[0] >= LOOK_BACK_NS]
        self._past.append((sim_time_ns, places_m))
        if not old or not len(old[-1][1]) or not len(places_m):
            return np.zeros(len(places_m), np.bool_)
        then_ns, before_m = old[-1]
        reach_m = self._below_mps * (sim_time_ns - then_ns) / 1e9 + JITTER_M
        apart_m = np.linalg.norm(places_m[:, None] - before_m, axis=2).min(axis=1)
        return np.asarray(apart_m <= reach_m)
