"""How many times were how long, by bucket."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

BUCKETS_S = (
    0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0,
)  # fmt: skip
_BUCKETS_NS = tuple(round(bound_s * 1e9) for bound_s in BUCKETS_S)


@dataclass(slots=True)
class Histogram:
    """How many times were how long; the last count is of those beyond all buckets."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(_BUCKETS_NS) + 1))
    sum_ns: int = 0

    def add(self, took_ns: int) -> None:
        """Counts one."""
        self.counts[bisect_left(_BUCKETS_NS, took_ns)] += 1
        self.sum_ns += took_ns
