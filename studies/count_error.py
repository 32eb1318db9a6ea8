"""How far the edge's lane counts are from the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.lanes import LaneIndex, Place
from perception.arrays import Floats
from recorder.run import Run
from recorder.tables import CountRow, TruthRow
from studies.ecvpr import by_frame


def lane_errors(run: Run) -> Floats:
    """Returns vehicles counted too many (N,), negative if too few, by frame and counted lane.

    Lanes before the stop bar and behind it, each within the reach that the edge counts in.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    errors = [row.vehicles - present for row, present in compared(run)]
    return np.array(errors, np.float64)


def compared(run: Run) -> Iterator[tuple[CountRow, int]]:
    """Yields each count of a frame that has truth, with how many vehicles truly were there.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    index = LaneIndex(run.setup.road_map)
    config = EdgeConfig.model_validate(run.scenario.get("edge", {}))
    numbers = {lane.id: number for number, lane in enumerate(run.setup.road_map.lanes)}
    truths = by_frame(run.rows(TruthRow))
    frame, vehicles = next(truths, (-1, []))
    for counted, rows in by_frame(run.rows(CountRow)):
        while 0 <= frame < counted:
            frame, vehicles = next(truths, (-1, []))
        if frame == counted:
            truth = _true_counts(index, config, numbers, vehicles)
            yield from ((row, truth[row.side][row.lane]) for row in rows)


def _true_counts(
    index: LaneIndex, config: EdgeConfig, numbers: dict[str, int], vehicles: list[TruthRow]
) -> dict[str, dict[str, int]]:
    lanes = np.array([numbers.get(vehicle.lane, -1) for vehicle in vehicles], np.int64)
    along_m = np.array([vehicle.lane_position_m for vehicle in vehicles], np.float64)
    before, behind = index.count(
        Place(lanes, along_m), upstream_m=config.upstream_m, downstream_m=config.downstream_m
    )
    return {"upstream": before, "downstream": behind}
