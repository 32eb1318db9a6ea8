"""When frames were, in simulated time."""

from __future__ import annotations

from dataclasses import dataclass

from recorder.run import Run
from studies.page.charts import Chart, ChartKind, Series
from studies.thin import note_on

TIME = "simulated time, s"


@dataclass(frozen=True, slots=True)
class Clock:
    """Simulated seconds by frame; a frame whose time was never heard is where it should be."""

    period_s: float
    start_s: float
    times_s: dict[int, float]

    @classmethod
    def of(cls, run: Run) -> Clock:
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
    """Returns a chart over simulated time; thinned series are explained under it."""
    said = " ".join(filter(None, (notes, note_on(series))))
    return Chart(title, TIME, y_label, series, kind, notes=said)
