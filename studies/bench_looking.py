"""What looking on costs a run: its frame rate with and without, some seconds of each in turn.

A run is compared with itself a few seconds before and after, for a machine that others use too is
not as fast now as it was a minute ago.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from perception.arrays import Floats, Ints

SETTLES_NS = 500_000_000
"""So long after a change what is measured still belongs to both sides."""
MIN_FRAMES = 10  # of a span, else it says nothing
INTERVAL = (5.0, 95.0)  # percentiles of the median's distribution
_RESAMPLED = 4000


@dataclass(frozen=True, slots=True)
class Span:
    """A time in which a run was looked on at in one way, or by nobody; on the monotonic clock."""

    way: str | None
    begin_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class LookingRow:
    """One way of looking on.

    `spans` are those with frames enough before, in and after; `alone_hz` the mean frame rate of the
    neighbours, when nobody looked on; `share` the median of what of it was left, between `low` and
    `high` with 90 % confidence (bootstrap).
    """

    way: str
    spans: int
    alone_hz: float
    share: float
    low: float
    high: float

    def as_json(self) -> dict[str, Any]:
        """Returns stable keys."""
        return asdict(self)


def rows_of(ticks_ns: Ints, spans: Sequence[Span]) -> Iterator[LookingRow]:
    """Yields a row for each way, in the order in which they came first.

    Args:
        ticks_ns: (N,), when each frame of the run began, on the monotonic clock.
        spans: one after the other, those with somebody between two without.
    """
    ticks_ns = np.sort(ticks_ns)
    rates = [_rate_hz(ticks_ns, span) for span in spans]
    seen: dict[str, list[tuple[float, float]]] = {}
    for number in range(1, len(spans) - 1):
        way = spans[number].way
        before, own, after = rates[number - 1 : number + 2]
        if way is not None and before and own and after:
            alone_hz = (before + after) / 2
            seen.setdefault(way, []).append((alone_hz, own / alone_hz))
    for way, pairs in seen.items():
        alone_hz, shares = np.array(pairs).T
        low, high = _interval(shares)
        yield LookingRow(
            way, len(pairs), float(alone_hz.mean()), float(np.median(shares)), low, high
        )


def _rate_hz(ticks_ns: Ints, span: Span) -> float | None:
    first, last = np.searchsorted(ticks_ns, [span.begin_ns + SETTLES_NS, span.end_ns])
    if last - first <= MIN_FRAMES:
        return None
    return float((last - first - 1) * 1e9 / (ticks_ns[last - 1] - ticks_ns[first]))


def _interval(shares: Floats) -> tuple[float, float]:
    """Returns within what the median lies, had other spans of this kind been measured."""
    drawn = np.random.default_rng(0).choice(shares, (_RESAMPLED, len(shares)))
    low, high = np.percentile(np.median(drawn, axis=1), INTERVAL)
    return float(low), float(high)
