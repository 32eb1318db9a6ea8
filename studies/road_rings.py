"""A junction's road as the rings that a map is drawn of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from protocol.roadmap import RoadMap
from studies.outlines import borders
from studies.page.charts import Ring


def road_rings(road_map: RoadMap) -> tuple[tuple[Ring, ...], tuple[Ring, ...]]:
    """Returns the surfaces of lanes and junction, and the lines between lanes."""
    sides = [(lane, *borders(lane)) for lane in road_map.lanes]
    surfaces = [ring([*left, *right[::-1]]) for _, left, right in sides]
    if len(road_map.junction) > 2:
        surfaces.append(ring(road_map.junction))
    lines = [
        ring(side) for lane, left, right in sides if not lane.internal for side in (left, right)
    ]
    return tuple(surfaces), tuple(lines)


def ring(points: Iterable[Sequence[float]]) -> Ring:
    """Returns points (N, 2 or more) as x, y in m, to the centimetre."""
    return tuple((round(float(p[0]), 2), round(float(p[1]), 2)) for p in points)
