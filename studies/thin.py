"""Long series with fewer points: the mean of each stretch, and how far it goes down and up."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from perception.arrays import Floats
from studies.page.charts import Numbers, Series

MOST_POINTS = 1500
STRETCHES = 300
NOTE = "Lines are means over short stretches of time; the surfaces reach from least to greatest."


def line(
    name: str, x: Sequence[float], y: Sequence[float | None], colour: str | None = None
) -> Series:
    """Returns a series as it is, or of `STRETCHES` points if it has more than `MOST_POINTS`.

    Of a stretch there are the mean, the least and the greatest, so that no extreme is lost; its x
    is that of its middle. None is a gap; one that is shorter than a stretch is bridged.
    """
    values = np.array([np.nan if one is None else one for one in y], np.float64)
    if len(values) <= MOST_POINTS:
        return Series(name, tuple(x), _numbers(values), colour=colour)
    edges = np.linspace(0, len(values), STRETCHES + 1).astype(np.int64)
    parts = [values[begin:end] for begin, end in pairwise(edges.tolist())]
    with warnings.catch_warnings():  # a stretch without values has no mean, as it should be
        warnings.simplefilter("ignore", RuntimeWarning)
        mean, low, high = (
            _numbers(np.array([of(part) for part in parts]))
            for of in (np.nanmean, np.nanmin, np.nanmax)
        )
    middles = tuple(x[int(at)] for at in (edges[:-1] + edges[1:]) // 2)
    return Series(name, middles, mean, low, high, colour=colour)


def note_on(series: tuple[Series, ...]) -> str:
    """Returns what must be said of a chart if its series are thinned."""
    return NOTE if any(one.low is not None for one in series) else ""


def _numbers(values: Floats) -> Numbers:
    return tuple(None if np.isnan(value) else value for value in values.tolist())
