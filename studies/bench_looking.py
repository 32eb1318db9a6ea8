"""What looking on costs a run: its frame rate with and without, at the same frames.

How long a frame takes depends on who drives where: far more than on who looks on. But two runs of
one seed have the same frames. So a run is made twice, and each stretch of frames is looked on at in
one of them; of two stretches that follow each other each run has one with somebody and one without,
so that neither what they show nor which run had the faster machine counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from perception.arrays import Floats, Ints

SETTLES_FRAMES = 20
"""So many frames after a change what is measured still belongs to both sides."""
INTERVAL = (5.0, 95.0)  # percentiles of the median's distribution
_RESAMPLED = 4000


@dataclass(frozen=True, slots=True)
class WatchedRun:
    """One of two runs: (N,) when each frame began, in ns, and which stretches were looked on at."""

    ticks_ns: Ints
    looked: frozenset[int]


@dataclass(frozen=True, slots=True)
class LookingRow:
    """One way of looking on.

    `pairs` are those of stretches that were looked on at in one run each; `alone_hz` the mean frame
    rate of them when nobody did; `share` the median of what of it was left, between `low` and
    `high` with 90 % confidence (bootstrap).
    """

    way: str
    pairs: int
    alone_hz: float
    share: float
    low: float
    high: float

    def as_json(self) -> dict[str, Any]:
        """Returns stable keys."""
        return asdict(self)


def row_of(way: str, runs: Sequence[tuple[WatchedRun, WatchedRun]], frames: int) -> LookingRow:
    """Returns what was left in a way of looking on; nan where no pair was complete.

    Args:
        way: its name.
        runs: of one seed, two and two; the first is looked on at in stretches 0, 2, 4 and so on.
        frames: of each stretch.
    """
    found = [pair for first, second in runs for pair in _pairs(first, second, frames)]
    if not found:
        return LookingRow(way, 0, *[float("nan")] * 4)
    alone_hz, shares = np.array(found).T
    low, high = _interval(shares)
    return LookingRow(way, len(found), float(alone_hz.mean()), float(np.median(shares)), low, high)


def _pairs(first: WatchedRun, second: WatchedRun, frames: int) -> Iterator[tuple[float, float]]:
    """Yields of each two stretches the frame rate alone, in Hz, and the share that was left."""
    common = min(len(first.ticks_ns), len(second.ticks_ns))
    for early in range(0, (common - 1) // frames - 1, 2):
        late, pair = early + 1, {early, early + 1}
        if first.looked & pair != {early} or second.looked & pair != {late}:
            continue
        looked = _times_s(first, early, frames), _times_s(second, late, frames)
        alone = _times_s(second, early, frames), _times_s(first, late, frames)
        rate_hz = 2 * (frames - SETTLES_FRAMES) / sum(alone)
        yield rate_hz, float(np.sqrt(np.prod(alone) / np.prod(looked)))


def _times_s(run: WatchedRun, stretch: int, frames: int) -> float:
    begin, end = stretch * frames + SETTLES_FRAMES, (stretch + 1) * frames
    return float(run.ticks_ns[end] - run.ticks_ns[begin]) / 1e9


def _interval(shares: Floats) -> tuple[float, float]:
    """Returns within what the median lies, had other stretches of this kind been measured."""
    drawn = np.random.default_rng(0).choice(shares, (_RESAMPLED, len(shares)))
    low, high = np.percentile(np.median(drawn, axis=1), INTERVAL)
    return float(low), float(high)
