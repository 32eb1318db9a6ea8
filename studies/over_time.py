"""Charts over simulated time: times of frames, and downsampling of long series."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from perception.arrays import Floats
from recording.run import Run
from studies.page.model import Chart, ChartKind, Numbers, Series

MAX_POINTS = 1500
INTERVALS = 300
NOTE = "Lines are means over short intervals of time; bands reach from the least to the greatest."


def thinned_series(
    name: str, x: Sequence[float], y: Sequence[float | None], colour: str | None = None
) -> Series:
    """Returns a series as it is, or of `INTERVALS` points if it has more than `MAX_POINTS`.

    An interval has its mean, least and greatest value, so that no extreme is lost; its x is that of
    its middle. None is a gap; one that is shorter than an interval is bridged.
    """
    values = np.array([np.nan if one is None else one for one in y], np.float64)
    if len(values) <= MAX_POINTS:
        return Series(name, tuple(x), _numbers(values), colour=colour)
    edges = np.linspace(0, len(values), INTERVALS + 1).astype(np.int64)
    parts = [values[begin:end] for begin, end in pairwise(edges.tolist())]
    with warnings.catch_warnings():  # an interval without values has no mean
        warnings.simplefilter("ignore", RuntimeWarning)
        mean, low, high = (
            _numbers(np.array([of(part) for part in parts]))
            for of in (np.nanmean, np.nanmin, np.nanmax)
        )
    middles = tuple(x[int(at)] for at in (edges[:-1] + edges[1:]) // 2)
    return Series(name, middles, mean, low, high, colour=colour)


def thinning_note(series: tuple[Series, ...]) -> str:
    """Returns the note for a chart whose series are thinned, else nothing."""
    return NOTE if any(one.low is not None for one in series) else ""


def _numbers(values: Floats) -> Numbers:
    return tuple(None if np.isnan(value) else value for value in values.tolist())


TIME = "simulated time, s"


@dataclass(frozen=True, slots=True)
class FrameClock:
    """Simulated seconds by frame; one that was not recorded is at its nominal time."""

    period_s: float
    start_s: float
    times_s: dict[int, float]

    @classmethod
    def of(cls, run: Run) -> FrameClock:
        """Reads the times of a run's frames."""
        rows = run.query("SELECT frame, sim_time_ns FROM frames WHERE sim_time_ns IS NOT NULL")
        times_s = {frame: ns / 1e9 for frame, ns in rows}
        period_s = float(run.scenario.get("frame_period_s", 0.1))
        first = min(times_s, default=0)
        return cls(period_s, times_s.get(first, 0.0) - first * period_s, times_s)

    def __getitem__(self, frame: int) -> float:
        """Returns the simulated time of a frame, s."""
        return self.times_s.get(frame, self.start_s + frame * self.period_s)


def over_time(
    title: str, y_label: str, series: tuple[Series, ...], kind: ChartKind = "line", notes: str = ""
) -> Chart:
    """Returns a chart over simulated time; a note explains thinned series."""
    text = " ".join(filter(None, (notes, thinning_note(series))))
    return Chart(title, TIME, y_label, series, kind, notes=text)
