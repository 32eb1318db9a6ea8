"""Long series with fewer points that look the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perception.arrays import Floats
from studies.page.charts import Numbers, Series

MOST_POINTS = 1500


def line(
    name: str, x: Sequence[float], y: Sequence[float | None], colour: str | None = None
) -> Series:
    """Returns a series of at most about `MOST_POINTS`; x ascends, None is a gap."""
    values = np.array([np.nan if one is None else one for one in y], np.float64)
    kept = kept_points(values, MOST_POINTS)
    shown: Numbers = tuple(None if np.isnan(values[i]) else float(values[i]) for i in kept)
    return Series(name, tuple(float(x[i]) for i in kept), shown, colour=colour)


def kept_points(values: Floats, most: int) -> list[int]:
    """Returns which of (N,) values to keep: of each stretch the least, the greatest and a gap.

    A gap is NaN. No extreme is lost, and a stretch without values stays one.
    """
    if len(values) <= most:
        return list(range(len(values)))
    per_stretch = 3 if np.isnan(values).any() else 2
    edges = np.linspace(0, len(values), max(1, (most - 2) // per_stretch) + 1).astype(np.int64)
    kept = {0, len(values) - 1}
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = values[begin:end]
        gaps = np.isnan(part)
        if not gaps.all():
            kept |= {begin + int(np.nanargmin(part)), begin + int(np.nanargmax(part))}
        if gaps.any():
            kept.add(begin + int(np.argmax(gaps)))
    return sorted(kept)
