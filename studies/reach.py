"""Which places belong to a signal: the road before its stop bar and behind it."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping

from protocol.roadmap import RoadMap

UPSTREAM_M = 200.0
DOWNSTREAM_M = 100.0


class Reach:
    """The lanes that lead to the stop bar and those that leave it, so far as the signal looks.

    The reach of Chen et al. 2022: 200 m upstream, 100 m downstream, measured along the lanes. The
    junction's own lanes lie behind the stop bar.
    """

    def __init__(
        self,
        road_map: RoadMap,
        upstream_m: float = UPSTREAM_M,
        downstream_m: float = DOWNSTREAM_M,
    ) -> None:
        lengths = {lane.id: lane.length_m for lane in road_map.lanes}
        onward = {lane.id: lane.successors for lane in road_map.lanes}
        incoming = [lane for lane in road_map.incoming if lane in lengths]
        behind = [after for lane in incoming for after in onward[lane] if after in lengths]
        starts = behind or [lane for lane in road_map.outgoing if lane in lengths]
        # by lane: metres from its end to the stop bar, and from the stop bar to its beginning
        self._before = _spread(incoming, road_map.predecessors, lengths, upstream_m)
        self._behind = _spread(starts, onward, lengths, downstream_m)
        self._lengths = lengths
        self._upstream_m, self._downstream_m = upstream_m, downstream_m

    def contains(self, lane: str, position_m: float) -> bool:
        """Whether a vehicle that has gone so far along a lane is within the reach."""
        if lane in self._before:
            left_m = self._lengths[lane] - position_m + self._before[lane]
            if left_m <= self._upstream_m:
                return True
        return lane in self._behind and self._behind[lane] + position_m <= self._downstream_m


def _spread(
    starts: Iterable[str],
    onward: Mapping[str, Iterable[str]],
    lengths: Mapping[str, float],
    limit_m: float,
) -> dict[str, float]:
    """Returns the shortest way from the starts to each lane within the limit (Dijkstra)."""
    reached: dict[str, float] = {}
    queue = [(0.0, lane) for lane in sorted(starts)]
    while queue:
        way_m, lane = heapq.heappop(queue)
        if lane in reached or way_m > limit_m:
            continue
        reached[lane] = way_m
        for after in onward.get(lane, ()):
            if after in lengths:
                heapq.heappush(queue, (way_m + lengths[lane], after))
    return reached
