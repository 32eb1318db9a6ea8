"""How far the edge's lane counts are from the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.lanes import LaneIndex, Place
from perception.arrays import Floats
from protocol.roadmap import RoadMap
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
    config = EdgeConfig.model_validate(run.scenario.get("edge", {}))
    counter = TrueCounts(run.setup.road_map, config.upstream_m, config.downstream_m)
    truths = by_frame(run.rows(TruthRow))
    frame, vehicles = next(truths, (-1, []))
    for counted, rows in by_frame(run.rows(CountRow)):
        while 0 <= frame < counted:
            frame, vehicles = next(truths, (-1, []))
        if frame == counted:
            truth = counter.count(vehicles)
            yield from ((row, truth[row.side].get(row.lane, 0)) for row in rows)


class TrueCounts:
    """Counts as the edge would, were it told where everybody is."""

    def __init__(self, road_map: RoadMap, upstream_m: float, downstream_m: float) -> None:
        self._index = LaneIndex(road_map)
        self._numbers = {lane.id: number for number, lane in enumerate(road_map.lanes)}
        self._upstream_m, self._downstream_m = upstream_m, downstream_m

    def count(self, vehicles: list[TruthRow]) -> dict[str, dict[str, int]]:
        """Returns vehicles by side of the stop bar and lane."""
        lanes = [self._numbers.get(vehicle.lane, -1) for vehicle in vehicles]
        along_m = [vehicle.lane_position_m for vehicle in vehicles]
        place = Place(np.array(lanes, np.int64), np.array(along_m, np.float64))
        before, behind = self._index.count(
            place, upstream_m=self._upstream_m, downstream_m=self._downstream_m
        )
        return {"upstream": before, "downstream": behind}
