"""How many vehicles were counted, and how many there were."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from protocol.errors import ConfigError
from recorder.run import Run
from recorder.tables import CountRow
from studies import palette
from studies.count_error import compared
from studies.ecvpr import FrameScore
from studies.of_run.clock import Clock, over_time
from studies.page.charts import Chart
from studies.page.model import Beside, Block, Column, Section, Table, Text
from studies.thin import line

Counted = list[tuple[CountRow, int | None]]
_COLUMNS = (
    Column("lane"),
    Column("side"),
    Column("counted", ".2f"),
    Column("present", ".2f"),
    Column("mean error", "+.2f"),
    Column("mean absolute error", ".2f"),
)


def vehicles_section(run: Run, clock: Clock, scores: list[FrameScore]) -> Section:
    """Returns counts and E-CVPR over time, and counts by lane."""
    counted = _counted(run)
    blocks: list[Block] = []
    charts = [_over_time(counted, clock)] if counted else []
    if scores:
        charts.append(_rate(scores, clock))
    else:
        blocks.append(Text("There is no truth to compare with, or no frame that was perceived."))
    if charts:
        blocks.append(Beside(tuple(charts)))
    blocks.append(_by_lane(counted) if counted else Text("No lane counts were recorded."))
    return Section("Vehicles", tuple(blocks))


def _counted(run: Run) -> Counted:
    """Returns all counts, with the truth where there is one."""
    try:
        found: Counted = list(compared(run))
    except ConfigError:  # without its setup, or of a scenario that this version does not know
        found = []
    return found or [(row, None) for row in run.rows(CountRow)]


def _over_time(counted: Counted, clock: Clock) -> Chart:
    frames: dict[int, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for row, present in counted:
        sums = frames[row.frame]
        sums[0] += row.vehicles
        sums[1] += np.nan if present is None else present
    x = [clock[frame] for frame in frames]
    series = [line("counted", x, [sums[0] for sums in frames.values()], palette.PLAIN)]
    there = [sums[1] for sums in frames.values()]
    if not np.isnan(there).all():
        series.insert(0, line("present", x, there, palette.QUIET))
    return over_time("Vehicles on the counted lanes", "vehicles", tuple(series))


def _rate(scores: list[FrameScore], clock: Clock) -> Chart:
    x = [clock[one.frame] for one in scores]
    shares = {
        "detected": [one.e_cvpr for one in scores],
        "visible": [one.visible_share for one in scores],
    }
    colours = {"detected": palette.GOOD, "visible": palette.QUIET}
    series = tuple(
        line(name, x, [None if share is None else 100 * share for share in values], colours[name])
        for name, values in shares.items()
        if any(share is not None for share in values)
    )
    return over_time("Vehicles within reach that were detected (E-CVPR)", "%", series)


def _by_lane(counted: Counted) -> Table:
    lanes: dict[tuple[str, str], list[tuple[int, int | None]]] = defaultdict(list)
    for row, present in counted:
        lanes[row.side, row.lane].append((row.vehicles, present))
    rows = tuple(
        (lane, side, *_means(pairs))
        for (side, lane), pairs in sorted(
            lanes.items(), key=lambda one: (one[0][0] != "upstream", one[0])
        )
    )
    return Table(_COLUMNS, rows, "By lane, mean over frames")


def _means(pairs: list[tuple[int, int | None]]) -> tuple[float | None, ...]:
    mean = float(np.mean([counted for counted, _ in pairs]))
    known = np.array([pair for pair in pairs if pair[1] is not None], np.float64).reshape(-1, 2)
    if not len(known):
        return mean, None, None, None
    error = known[:, 0] - known[:, 1]
    return mean, float(known[:, 1].mean()), float(error.mean()), float(np.abs(error).mean())
